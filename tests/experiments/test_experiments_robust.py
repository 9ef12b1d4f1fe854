import csv
from dataclasses import replace

import numpy as np
import pytest
from experiment_samples import quick_bench

from train.experiments.sensor import robust
from train.experiments.support.sweeps import (
    TAPS,
    all_sweeps,
    in_reverse,
    mistaken,
    plain_set,
    with_dead_taxels,
    with_lost_scans,
)

EARLIER_ONLY = {"angle between taps", "taps of another surface", "earlier taps in reverse"}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return quick_bench(tmp_path_factory)


@pytest.fixture(scope="module")
def plain(bench):
    return plain_set(bench)


@pytest.fixture(scope="module")
def page(bench, tmp_path_factory):
    return robust.run(bench, tmp_path_factory.mktemp("reports"))


@pytest.fixture(scope="module")
def numbered(plain):
    """The same taps, every reading a number of its own that identifies its place, never 0."""
    return replace(
        plain,
        newest=np.arange(1, plain.newest.size + 1).reshape(plain.newest.shape),
        earlier=-np.arange(1, plain.earlier.size + 1).reshape(plain.earlier.shape),
    )


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_the_report_has_every_nuisance_at_its_default_and_beyond(page, bench, plain):
    rows = rows_of(page.with_suffix(".csv"))
    assert page.with_suffix(".png").stat().st_size > 10_000
    assert set(rows[0]) >= {"PSNR dB", "loss dB", "SSIM", "IoU", "parameters", "MMAC", "run time ms"}
    assert {row["nuisance"] for row in rows} == {sweep.name for sweep in all_sweeps(bench, plain)}
    assert {row["model"] for row in rows} == {"stsr", "mtsr4", "linear map", "bilinear"}
    default = [row for row in rows if "default" in row["mark"]]
    assert len(default) == len({(row["nuisance"], row["model"]) for row in rows})
    assert {row["loss dB"] for row in default} == {"0.00 (0.00..0.00)"}  # the very same scans
    assert len(rows_of(page.with_name("robust-bounds.csv"))) == len(default)
    text = page.read_text()
    assert "quick run" in text
    assert "mtsr4 against stsr" in text


def test_a_method_of_one_tap_does_not_mind_what_became_of_the_earlier_ones(page):
    for row in rows_of(page.with_suffix(".csv")):
        if row["nuisance"] in EARLIER_ONLY - {"angle between taps"} and row["model"] != "mtsr4":
            assert row["loss dB"] in ("0.00 (0.00..0.00)", "-0.00 (0.00..0.00)")


def test_a_sweep_changes_the_readings_and_nothing_else(bench, plain):
    for sweep in all_sweeps(bench, plain):
        default, strongest = sweep.frozen(sweep.default), sweep.frozen(sweep.severities[-1])
        assert sweep.default in sweep.severities
        assert default.sha256() == plain.sha256(), sweep.name
        assert strongest.sha256() != plain.sha256(), sweep.name
        if sweep.name != "pose error":
            np.testing.assert_allclose(strongest.indentation_mm, plain.indentation_mm, rtol=1e-5)
            np.testing.assert_allclose(strongest.unit_patterns, plain.unit_patterns, atol=2e-3)
        same_newest = np.abs(strongest.newest - plain.newest).max() <= 1  # solved again, a rounding may differ
        assert same_newest == (sweep.name in EARLIER_ONLY), sweep.name


def test_exactly_so_many_taxels_are_dead_on_a_taps_sensor_and_stay_dead_when_more_are(numbered):
    before = np.zeros((len(numbered.surface), 4, 4), dtype=bool)
    for dead in range(17):
        found = with_dead_taxels(numbered, dead)
        silent = (found.earlier == 0).all(axis=(1, 2))
        assert (silent.sum(axis=(1, 2)) == dead).all()
        np.testing.assert_array_equal(found.newest == 0, np.repeat(silent[found.tap][:, None], 3, axis=1))
        assert (silent | ~before).all()
        before = silent
    np.testing.assert_array_equal(with_dead_taxels(numbered, 0).newest, numbered.newest)
    some = (with_dead_taxels(numbered, 4).earlier == 0).any(axis=(1, 2))
    assert len(np.unique(some, axis=0)) > 1  # each sensor has its own


def test_a_lost_scan_leaves_the_last_one_that_came(numbered):
    np.testing.assert_array_equal(with_lost_scans(numbered, 0).newest, numbered.newest)
    shown = {int(reading.flat[0]): frame for frame, reading in enumerate(numbered.newest)}

    def heard(chance):
        return np.array([shown[int(reading.flat[0])] for reading in with_lost_scans(numbered, chance).newest])

    frames = np.arange(len(numbered))
    first = np.searchsorted(numbered.tap, numbered.tap)
    np.testing.assert_array_equal(heard(1), first)
    half = heard(0.5)
    assert (half <= frames).all()
    assert (numbered.tap[half] == numbered.tap).all()
    assert (half[half] == half).all()  # what stands has itself come
    assert 0.3 < np.mean(half < frames) < 0.7
    assert (heard(0.25) >= half).all()


def test_the_oldest_taps_are_those_of_another_surface(bench):
    clean = bench.held_out("test")
    for wrong in range(TAPS):
        found = mistaken(clean, wrong)
        right = TAPS - wrong
        np.testing.assert_array_equal(found.counts[:, :right], clean.counts[:, :right])
        other = np.roll(clean.counts[:, right:TAPS], -4, axis=0)  # four angles of a surface
        np.testing.assert_array_equal(found.counts[:, right:TAPS], other)
        np.testing.assert_array_equal(found.force_n[:, right:TAPS], np.roll(clean.force_n[:, right:TAPS], -4, axis=0))
    assert (np.roll(clean.surfaces, -4) != clean.surfaces).all()
    np.testing.assert_allclose(np.roll(clean.poses, -4, axis=0)[:, 0, 2], clean.poses[:, 0, 2], atol=4)


def test_reversing_the_earlier_taps_twice_changes_nothing(numbered):
    once = in_reverse(numbered)
    for tap in range(TAPS - 1):
        np.testing.assert_array_equal(once.earlier[:, tap], numbered.earlier[:, TAPS - 2 - tap])
    np.testing.assert_array_equal(in_reverse(once).earlier, numbered.earlier)
    np.testing.assert_array_equal(once.newest, numbered.newest)


def test_the_severity_of_a_loss_lies_on_the_line_between_two_severities():
    severities = [0, 1, 2, 4]
    assert robust.severity_of_loss(severities, [30, 28, 26, 22], 0, 1) == pytest.approx(0.5)
    assert robust.severity_of_loss(severities, [30, 28, 26, 22], 1, 3) == pytest.approx(2.5)
    assert robust.severity_of_loss(severities, [30, 10, 30, 26], 2, 1) == pytest.approx(2.5)  # not what is weaker
    assert robust.severity_of_loss(severities, [30, 20, 30, 27], 1, 1) is None
    assert robust.severity_of_loss(severities, [30, 29.5, 29.1, 29], 0, 1) is None
    assert robust.severity_of_loss([1, 0.4, 0.2], [30, 30, 28], 0, 1) == pytest.approx(0.3)  # stronger may be less
