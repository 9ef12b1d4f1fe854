"""Reports of the shipped models: their scores, their baselines, and their pages in miniature."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from edge_samples import make_contract, make_pad_contract, write_model
from experiment_samples import quick_bench

from edge.errors import ModelError
from edge.inference.contract import CONTRACT_VERSION
from edge.inference.onnx_session import ModelSession
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import load_frozen_presses
from train.experiments.sensor import families, pads
from train.experiments.support import baselines, kriging, nominal, oracle, scores, shipped
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import NOMINAL
from train.physics.sensor_noise import Nuisances


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Workbench with a model that makes squares of taxels, with pad and traction."""
    folder = tmp_path_factory.mktemp("models")
    write_model(folder / "stsr-int8.onnx", make_pad_contract(taps=1, output_full_scale=0.5))
    return replace(quick_bench(tmp_path_factory), models=folder)


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


class TestScores:
    def test_pooled_is_of_the_mean_squared_error(self):
        assert scores.pooled_db(np.array([30.0, 30.0])) == pytest.approx(30)
        squared = np.array([1e-2, 1e-4])
        assert scores.pooled_db(-10 * np.log10(squared)) == pytest.approx(-10 * np.log10(squared.mean()))

    def test_own_peak_is_lower_for_lower_patterns(self):
        truth = np.zeros((2, 4, 4))
        truth[0, 0, 0], truth[1, 0, 0] = 0.5, 0.05
        assert scores.own_peak_db(np.array([30.0, 30.0]), truth, 0.5) == pytest.approx([30, 10])


@pytest.fixture(scope="module")
def few():
    return load_frozen_presses().pick(np.arange(5))


class TestShipped:
    def test_readings_are_divided_by_gains_and_the_pad_enters_where_they_are_known(self, bench, few):
        model = shipped.load_shipped(bench.models)
        found = {known: shipped.infer_presses(model, few, known).patterns for known in shipped.KNOWN}
        pads = [few.pad(index, gains=True) for index in range(5)]
        scaled = [model.contract.scale_window(window) for window in few.windows(1, gains_known=True)]
        by_hand = [model.run(one, model.contract.pad_row(pad)).copy() for one, pad in zip(scaled, pads, strict=True)]
        assert found[shipped.ALL] == pytest.approx(np.stack(by_hand), rel=1e-5)
        assert not np.allclose(found[shipped.PAD], found[shipped.ALL])
        assert not np.allclose(found[shipped.NOTHING], found[shipped.FORCE])
        alone = [Pad(counts_per_newton=pad.counts_per_newton) for pad in pads]
        assert shipped.known_pads(few, shipped.FORCE) == alone

    def test_a_model_of_the_version_before_takes_no_pad(self, few, tmp_path):
        write_model(tmp_path / "old.onnx", make_contract(taps=1, version=4))
        model = ModelSession(tmp_path / "old.onnx")
        known, unknown = (shipped.infer_presses(model, few, known) for known in (shipped.ALL, shipped.NOTHING))
        assert np.array_equal(known.patterns, unknown.patterns) and unknown.traction_kpa is None
        assert unknown.run_time_us > 0

    def test_a_model_that_is_not_there_is_named(self, tmp_path):
        with pytest.raises(ModelError, match=r"stsr-int8\.onnx"):
            shipped.load_shipped(tmp_path)


class TestBaselines:
    def test_the_nearest_press_is_the_one_that_was_read(self):
        rng = np.random.default_rng(1)
        newest = rng.normal(0, 500, (50, 3, 4, 4)).astype(np.float32)
        patterns = rng.uniform(0, 0.5, (50, 40, 40)).astype(np.float16)
        one, two = (baselines.NearestPresses(newest, patterns, count) for count in (1, 2))
        assert np.array_equal(one(newest[7:9] + 1), patterns[7:9].astype(np.float32))
        both = np.concatenate([newest[:1], newest[:1]])  # the nearest is far nearer than any other
        assert np.abs(two(both) - patterns[0]).max() > 0.01

    def test_axes_count_in_network_units(self):
        newest = np.zeros((3, 3, 4, 4), dtype=np.float32)
        newest[1, 2], newest[2, 0] = 300, 200  # z off by .3 units, x by .4
        patterns = np.zeros((3, 40, 40), dtype=np.float16)
        patterns[1], patterns[2] = 0.1, 0.2
        nearest = baselines.NearestPresses(newest[1:], patterns[1:], 1)
        assert nearest(newest[:1]).max() == pytest.approx(0.1, abs=1e-3)

    def test_kriging_finds_a_light_smooth_press(self):
        """The readings of its own fields are recovered, and a longer length is smoother."""
        pad = GrippedPad(NOMINAL)
        field = kriging.Kriging(pad)
        across = (np.arange(pad.size) - (pad.size - 1) / 2) * pad.cell_mm
        bell = np.exp(-((across[:, None] - 2) ** 2 + (across + 1) ** 2) / (2 * 2.5**2))
        pressure = (1e-3 * bell).astype(np.float32)
        reading = pad.skin.frames(pressure[None, None])[0, 0].reshape(-1)
        truth = field._solver.displacement_mm(pressure[None])[0, 1:-1, 1:-1]
        found = {length: (reading @ field.matrix(length, 1e-6)).reshape(40, 40) for length in (0.5, 2.0)}
        off = {
            length: np.sqrt(np.mean((one - truth) ** 2)) / np.sqrt(np.mean(truth**2)) for length, one in found.items()
        }
        assert off[2.0] < 0.1 and off[2.0] < off[0.5]


def test_the_oracle_finds_a_press_again_from_a_place_nearby():
    known = oracle.KnownSurface("small triangle", NOMINAL)
    start = oracle.PRIOR_MEAN + np.array([0, 0, 10, 0, 0, 0, 0, 0, 0, 0])
    numbers = start + np.array([0.4, -0.3, 4, 0.002, 0, 0.1, 0.1, 0, 0, 0])
    press = known.press(numbers[None])
    found = known.fit(press.counts.reshape(-1), start, 3)
    off = [
        np.sqrt(np.mean((pattern - press.patterns[0]) ** 2))
        for pattern in (known.press(start[None]).patterns[0], found)
    ]
    assert off[1] < 0.2 * off[0]


def test_what_is_common_to_all_taxels_of_an_axis_covaries():
    covariance = oracle.error_covariance(np.zeros(48), Nuisances())
    assert covariance[32, 40] > 1500 and covariance[0, 40] == 0 and covariance[0, 8] < covariance[32, 40]
    assert np.linalg.eigvalsh(covariance).min() > 0


class TestPads:
    def test_one_constant_is_off(self):
        assert pads.OffPad("thickness_mm", -10).pad == replace(NOMINAL, thickness_mm=NOMINAL.thickness_mm * 0.9)
        assert pads.OffPad("free_sides", 20).pad.free_sides == pytest.approx(0.2)
        assert pads.NONE_OFF.pad == NOMINAL
        assert not pads.OffPad("poisson", 20).can_be and not pads.OffPad("free_sides", -5).can_be
        assert pads.OffPad("poisson", 10).can_be

    def test_losses_are_press_by_press(self):
        up, down = pads.OffPad("pitch_mm", 5), pads.OffPad("pitch_mm", -5)
        psnr = {pads.NONE_OFF: np.array([30.0, 20.0]), up: np.array([29.0, 19.0])}
        (row,) = pads.loss_rows({"model": psnr}, [pads.NONE_OFF, up, down])
        assert row["model, up"] == "1.00 (1.00..1.00)" and row["model, down"] is None


def test_the_last_frame_of_every_tap_is_at_full_press(bench):
    frozen = nominal.load_frozen_set(nominal.BUNDLE_DIR / "frozen.npz")
    last = nominal.at_full_press(frozen)
    assert len(last) == len(frozen.surface) and np.array_equal(last.tap, np.arange(len(last)))
    deepest = [frozen.indentation_mm[frozen.tap == tap].max() for tap in last.tap]
    assert last.indentation_mm == pytest.approx(deepest)


class TestPages:
    def test_families(self, bench, tmp_path, monkeypatch):
        monkeypatch.setattr(nominal, "TEST_FIGURES", 2)
        page = families.run(bench, tmp_path).read_text()
        assert (
            page.startswith("# families\n") and "quick run" in page and f"contract version {CONTRACT_VERSION}" in page
        )
        methods = {row["method"]: row for row in rows_of(tmp_path / "families-methods.csv")}
        assert {"model", "model, all known", "bilinear", "linear map", "nearest 8", "kriging"} <= set(methods)
        assert all(float(row["run time us"]) > 0 for row in methods.values())
        named = rows_of(tmp_path / "families.csv")
        assert len(named) == 22 and named[-1]["family"] == "all" and "model, over" in named[0]
        assert {row["method"] for row in rows_of(tmp_path / "families-oracle.csv")} >= {"oracle", "model"}
        assert len(rows_of(tmp_path / "families-nominal.csv")) == 9
        assert (tmp_path / "families.png").exists()

    def test_pads(self, bench, tmp_path):
        write_model(tmp_path / "before.onnx", make_contract(taps=1, version=4))
        pads.run(replace(bench, before=tmp_path / "before.onnx"), tmp_path)
        rows = rows_of(tmp_path / "pads.csv")
        assert [row["constant"] for row in rows] == list(pads.CONSTANTS[:2])
        assert all(row["model before, down"] and row["model, all known, up"] for row in rows)
