"""Reports of the shipped models on other pads, families and taps: their parts, and their pages in miniature."""

import csv
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from edge_samples import make_pad_contract, write_model
from experiment_samples import quick_bench

from train.data.frozen_presses import load_frozen_presses
from train.experiments.sensor import families, pads, posed_taps, shipped
from train.physics.pad_draws import NOMINAL


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Workbench with a model that makes squares of taxels, with pad, traction and intervals."""
    folder = tmp_path_factory.mktemp("models")
    levels = {"90": [1.6] * 4}
    contract = make_pad_contract(taps=1, output_full_scale=0.5, interval_factor=1.6, interval_levels=levels)
    write_model(folder / "stsr-int8.onnx", contract)
    return replace(quick_bench(tmp_path_factory), models=folder)


@pytest.fixture(scope="module")
def few():
    return load_frozen_presses().pick(np.arange(5))


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_readings_are_divided_by_gains_and_the_pad_enters_where_they_are_known(bench, few):
    model = bench.model()
    found = {known: shipped.infer_presses(model, few, known).patterns for known in (shipped.NOTHING, shipped.ALL)}
    known = [few.pad(index, gains=True) for index in range(5)]
    scaled = [model.contract.scale_window(window) for window in few.windows(1, gains_known=True)]
    by_hand = [model.run(one, model.contract.pad_row(pad)).copy() for one, pad in zip(scaled, known, strict=True)]
    assert found[shipped.ALL] == pytest.approx(np.stack(by_hand), rel=1e-5)
    assert not np.allclose(found[shipped.NOTHING], found[shipped.ALL])


def test_the_nearest_press_is_the_one_that_was_read_in_network_units():
    newest = np.zeros((3, 3, 4, 4), dtype=np.float32)
    newest[1, 2], newest[2, 0] = 300, 200  # z off by .3 units, x by .4
    patterns = np.random.default_rng(1).uniform(0, 0.5, (3, 40, 40)).astype(np.float16)
    nearest, two = (families.nearest_presses(newest[:1], newest[1:], patterns[1:], count) for count in (1, 2))
    assert np.array_equal(nearest, patterns[1:2].astype(np.float32))
    np.testing.assert_allclose(two[0], patterns[1:].astype(np.float32).mean(axis=0), rtol=1e-6)


def test_one_constant_of_a_pad_is_off():
    assert pads.OffPad("thickness_mm", -10).pad == replace(NOMINAL, thickness_mm=NOMINAL.thickness_mm * 0.9)
    assert pads.OffPad("free_sides", 20).pad.free_sides == pytest.approx(0.2)
    assert pads.NONE_OFF.pad == NOMINAL
    assert not pads.OffPad("poisson", 20).can_be and not pads.OffPad("free_sides", -5).can_be
    assert pads.OffPad("poisson", 10).can_be


@pytest.mark.night
def test_the_families_in_miniature(bench, tmp_path):
    page = families.run(bench, tmp_path).read_text()
    assert page.startswith("# families\n") and "quick run" in page
    methods = {row["method"]: row for row in rows_of(tmp_path / "families-methods.csv")}
    assert set(methods) == {"model", "model, all known", "bilinear", "linear map", "nearest 8"}
    assert all(float(row["run time us"]) > 0 for row in methods.values())
    named = rows_of(tmp_path / "families.csv")
    assert len(named) == 22 and named[-1]["family"] == "all" and "model, over" in named[0]
    *by_family, known = rows_of(tmp_path / "families-intervals.csv")
    assert len(by_family) == 22 and (known["family"], known["method"]) == ("all", "model, all known")
    assert all(0 <= float(known[region].split()[0]) <= 100 for region in ("inside", "edge", "near", "far"))
    assert (tmp_path / "families.png").exists()


@pytest.mark.night
def test_the_pads_in_miniature(bench, tmp_path):
    pads.run(bench, tmp_path)
    rows = rows_of(tmp_path / "pads.csv")
    assert [row["constant"] for row in rows] == list(pads.CONSTANTS[:2])
    assert all(row["model, down"] and row["model, all known, up"] for row in rows)


@pytest.mark.night
def test_the_taps_in_miniature(tmp_path, tmp_path_factory):
    posed_taps.run(quick_bench(tmp_path_factory), tmp_path)
    parts = ("schedules", "known", "families", "wrong-poses", "paper")
    tables = {part: rows_of(tmp_path / f"posed-taps-{part}.csv") for part in parts}
    assert {row["schedule"] for row in tables["schedules"]} == set(posed_taps.SCHEDULES)
    assert {row["taps"] for row in tables["schedules"]} == {"1", "2", "3", "4", "7"}
    assert [row["off mm"] for row in tables["wrong-poses"]][:4] == ["0.2", "0.5", "1.0", "2.0"]
    assert all(row["over one tap, not stated"] and row["left out %, stated"] for row in tables["wrong-poses"])
    paper = [(row["model"], row["taps"]) for row in tables["paper"]]
    assert paper == [("stsr-int8", "1"), ("mtsr-int8", "2"), ("mtsr-int8", "4"), ("mtsr-int8", "7")]
    found = [row["PSNR dB"] for row in tables["paper"]]
    assert all(one != other for one, other in pairwise(found)), "each sees something else"
    assert [bool(row["over one tap"]) for row in tables["paper"]] == [False, True, True, True]
