"""Zeroing: what a still pad reads, what is refused as motion or load, the deformation against it, and its files."""

import json

import numpy as np
import pytest
from edge_samples import BASELINE, REST
from hostile_samples import one_line
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.errors import BaselineRefusedError, RecordingError
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ABSENT, Scan, ScanSeries
from firmware_bridge.zeroing.baseline import (
    LAST_UNIX_S,
    Baseline,
    BaselineEstimator,
    deformation,
    load_baselines,
    save_baselines,
)

NOISE_COUNTS = (2.6, 2.6, 3.9)
STEPS = np.arange(100)


def still(count: int, seed: int = 0, rest: np.ndarray = REST, noise_counts=NOISE_COUNTS) -> np.ndarray:
    """Scans of a pad that nothing moves: (count, 3, 4, 4)."""
    noise = np.random.default_rng(seed).normal(0, 1, (count, 3, 4, 4)) * np.array(noise_counts)[:, None, None]
    return np.rint(rest + noise).astype(np.int32) % 65536


def moved(counts: np.ndarray, axis: int = 2) -> np.ndarray:
    """Scans without noise of a pad one of whose taxels moves so, in [counts] a scan, and no other too far."""
    scans = np.tile(REST, (len(counts), 1, 1, 1))
    scans[:, 0, 0, 0] += np.arange(len(counts)) % 2  # so that no scan is sent again
    scans[:, 2, 0, 1] += 20 * (np.arange(len(counts)) % 10 == 0)  # more than x and y may move, less than z
    scans[:, axis, 3, 1] += counts
    return scans


def scans_of(counts: np.ndarray) -> list[Scan]:
    series = ScanSeries("4", USPA44)
    return [series.close(np.array(one, dtype=np.int32), n) for n, one in enumerate(counts)]


def zeroed(counts: np.ndarray, estimator: BaselineEstimator | None = None, silent=None) -> Baseline:
    """The baseline that comes with the last of these scans, and no sooner."""
    estimator = estimator or BaselineEstimator(min_scans=len(counts))
    *before, baseline = [estimator.push(scan, silent) for scan in scans_of(counts)]
    assert not any(before) and baseline is not None
    return baseline


def made(counts: np.ndarray = REST, sensor: str = "4", created_unix_s: float = 1_000.0) -> Baseline:
    return Baseline.of(sensor, counts, created_unix_s, 100, "start-up")


def test_a_still_pad_gives_its_median():
    estimator = BaselineEstimator(clock=lambda: 1234.5)
    counts = still(100)
    baseline = zeroed(counts, estimator)
    assert Baseline.from_counts("4", counts, 1234.5).id == baseline.id
    for wrong, words in ((65_536, " to 65536, expected"), (ABSENT, "-1 to .*, expected")):
        with pytest.raises(BaselineRefusedError, match=words):
            Baseline.from_counts("6", np.where(counts == counts.max(), wrong, counts), 99.0)
    assert (baseline.counts == np.median(counts, axis=0)).all()
    assert baseline.counts.dtype == np.float32 and not baseline.counts.flags.writeable
    assert (baseline.sensor, baseline.scans, baseline.origin, baseline.created_unix_s) == ("4", 100, "start-up", 1234.5)
    assert baseline.age_s(1300.0) == 65.5 and estimator.scans == 0
    for seed in range(1, 40):
        zeroed(still(100, seed, noise_counts=(2.8, 2.8, 4.7)))  # the loudest pad on record
    for rest in (0, 443, 65_535, 32_768):  # round the circle of counts
        counts = zeroed(still(100, rest=np.full((3, 4, 4), rest))).counts
        assert abs((counts - rest + 32_768) % 65_536 - 32_768).max() < 2.5
        assert counts.min() >= 0 and counts.max() < 65_536
    with pytest.raises(ValueError, match="at least 3"):
        BaselineEstimator(min_scans=2)


@pytest.mark.parametrize(
    ("taken", "refused", "words"),
    [
        (100 * (STEPS % 20 == 7), 100 * ((STEPS % 20 == 7) | (STEPS == 50)), "z moved by 100 counts"),
        (-100 * (STEPS % 20 == 7), -100 * ((STEPS % 20 == 7) | (STEPS == 50)), "z moved by 100 counts"),
        (25 * (STEPS % 10 == 0), 26 * (STEPS % 10 == 0), r"z moved by 26 counts .* at most 25 .* still and free"),
        (15 * (STEPS % 10 == 0), 16 * (STEPS % 10 == 0), "x moved by 16 counts"),
        (15 * (STEPS % 10 == 0), 16 * (STEPS % 10 == 0), "y moved by 16 counts"),
        # The median of 33 scans moves with the seventeenth of them.
        (11 * (STEPS[:99] >= 83), 11 * (STEPS[:99] >= 82), "z crept by 11 counts .* at most 10"),
        (11 * (STEPS[:99] < 16), 11 * (STEPS[:99] < 17), "z crept by 11 counts"),
        (10 * (STEPS[:99] >= 82), 11 * (STEPS[:99] >= 82), "z crept by 11 counts"),
    ],
)
def test_motion_is_refused_from_the_first_count_beyond_a_limit(taken, refused, words):
    axis, estimator = "xyz".index(words[0]), BaselineEstimator(min_scans=len(taken))
    with pytest.raises(BaselineRefusedError, match=rf"taxel \(3, 1\) {words}"):
        zeroed(moved(refused, axis), estimator)
    zeroed(moved(taken, axis), estimator)  # it has started over


@pytest.mark.parametrize("silent", [None, np.arange(16).reshape(4, 4) == 0])
@pytest.mark.parametrize(
    ("axis", "load", "refused"), [(2, 200, False), (2, 201, True), (2, -600, False), (0, 600, False)]
)
def test_a_load_is_seen_against_a_reference_on_z_above_it(axis, load, refused, silent):
    counts = moved(np.full(100, load), axis)
    if silent is not None:
        counts[:, :, silent] = ABSENT
        counts[:, 0, 0, 1] += STEPS % 2
    if not refused:
        found = zeroed(counts, BaselineEstimator(reference=BASELINE), silent)
        assert (np.isnan(found.counts).all(axis=0) == (silent is not None and silent)).all()
        return
    words = rf"\(3, 1\) z is {load} counts above the baseline {BASELINE.id}"
    with pytest.raises(BaselineRefusedError, match=words):
        zeroed(counts, BaselineEstimator(reference=BASELINE), silent)
    zeroed(counts, silent=silent)  # a documented limit: without a reference such a load is zeroed away


def test_torn_and_repeated_scans_are_no_samples():
    counts = np.stack([REST, REST + 1, REST + 1])
    counts[2, 0, 0, 0] += 2
    gap = counts[1].copy()
    gap[:, 0, 0] = ABSENT
    zeroed(np.stack([counts[0], gap, counts[1], counts[1], counts[1], counts[2]]), BaselineEstimator(min_scans=3))


@given(st.integers(0, 65_535), st.integers(-32_767, 32_767), st.sampled_from((0, 0.5)), st.booleans())
@settings(deadline=None)
def test_deformation_is_the_short_way_round(rest, pressed, half, unknown):
    """Halves are kept, and a gap of the scan or of the baseline stays one and keeps no other from wrapping round."""
    scan = np.full((3, 4, 4), (rest + pressed) % 65_536, dtype=np.int32)
    scan[:, 1, 3] = ABSENT
    counts = np.full((3, 4, 4), (rest - half) % 65_536, dtype=np.float64)
    counts[:, 0, 0] = np.nan if unknown else counts[0, 1, 1]
    seen = deformation(scan, made(counts))
    gaps = np.zeros((4, 4), dtype=bool)
    gaps[1, 3], gaps[0, 0] = True, unknown
    assert seen.dtype == np.float32 and (np.isnan(seen) == gaps).all()
    assert (seen[:, ~gaps] == pressed + half).all()


def test_a_taxel_given_up_has_no_rest_until_the_next_zeroing():
    """One that comes and goes does not put zeroing off; scans without another taxel are no samples meanwhile."""
    counts = still(201)
    counts[50, :, 0, 0] = ABSENT
    counts[:, :, 1, 1] = ABSENT
    counts[:20, :, 2, 2] = ABSENT
    one, two = np.zeros((2, 4, 4), dtype=bool)
    one[1, 1] = two[1, 1] = two[2, 2] = True
    estimator = BaselineEstimator()
    found = [estimator.push(scan, two if number < 20 else one) for number, scan in enumerate(scans_of(counts))]
    assert [number for number, baseline in enumerate(found) if baseline is not None] == [100, 200]
    for baseline, given_up in ((found[100], two), (found[200], one)):
        np.testing.assert_array_equal(np.isnan(baseline.counts), np.broadcast_to(given_up, (3, 4, 4)))
        np.testing.assert_allclose(baseline.counts[:, ~given_up], REST[:, ~given_up], atol=2)


# Files: saved, loaded, written by hand and refused.


def with_cell(cell: object) -> list:
    counts: list = REST.tolist()
    counts[1][2][3] = cell
    return counts


def test_the_id_is_of_sensor_counts_and_time_not_of_drift():
    others = [made(sensor="6"), made(REST + 1), made(created_unix_s=1_001.0)]
    assert len({BASELINE.id, *(other.id for other in others)}) == 4
    assert made().id == BASELINE.id == "d148ecd3"
    drifted = made().moved(np.full(REST.shape, 65_000.0))
    assert drifted.id == made().id and drifted.counts == pytest.approx((REST + 65_000) % 65_536)


def test_saved_baselines_come_back(tmp_path):
    path = tmp_path / "zero.json"
    saved = [made(), made(REST + 0.5, "6", 123.456), made(sensor="8", created_unix_s=float("nan"))]
    save_baselines(str(path), saved)
    loaded = load_baselines(str(path))
    assert list(loaded) == ["4", "6", "8"]
    for baseline, got in zip(saved, loaded.values(), strict=True):
        assert (got.counts == baseline.counts).all() and (got.id, got.scans) == (baseline.id, 100)
        np.testing.assert_equal(got.created_unix_s, baseline.created_unix_s)
        assert got.origin == "file"
    with pytest.raises(RecordingError, match=r"none/zero\.json: cannot be written: "):
        save_baselines(tmp_path / "none" / "zero.json", saved)


@pytest.mark.parametrize(
    ("cell", "created_unix_s", "scans"), [(0, LAST_UNIX_S, 1), (65_535.9, 1, 2**31 - 1), (1, np.nan, 1)]
)
def test_a_baseline_written_by_hand_as_the_docs_say_needs_no_id(tmp_path, cell, created_unix_s, scans):
    path = tmp_path / "zero.json"
    date = {} if np.isnan(created_unix_s) else {"created_unix_s": created_unix_s}
    entry = {"sensor": "4", **date, "scans": scans, "counts": with_cell(cell)}
    path.write_text(json.dumps({"format": "tactile-baseline", "version": 1, "baselines": [entry]}))
    baseline = load_baselines(path)["4"]
    assert baseline.counts[1, 2, 3] == np.float32(cell) and baseline.scans == scans
    np.testing.assert_equal(baseline.created_unix_s, created_unix_s)


ENTRY = {"sensor": "4", "created_unix_s": 1_000.0, "scans": 100, "counts": REST.tolist()}
WRONG = {
    "format": ["other"],
    "version": [2],
    "baselines": [[], [{}, 1], [ENTRY, ENTRY]],
    "sensor": ["", 4],
    "created_unix_s": [0, "5", 1e300],
    "scans": [0, 2**31],
    "counts": [
        *(None, [[[]], [[]], [[]]], REST.tolist()[:2], REST.ravel().tolist(), [REST.tolist()] * 3),
        *([[[1, 2], [3]], [[4]], [[5]]], *map(with_cell, (65_536, -1, float("nan"), False))),
    ],
    "id": ["00000000", None],  # as where the counts were changed
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in WRONG.items() for value in values])
def test_a_value_that_cannot_be_is_refused_by_its_key(tmp_path, key, value):
    path = tmp_path / "zero.json"
    save_baselines(path, [made()])
    document = json.loads(path.read_text())
    (document if key in document else document["baselines"][0])[key] = value
    path.write_text(json.dumps(document))
    shown = "'sensor': '4', expected each sensor once" if value == [ENTRY, ENTRY] else f"'{key}': "
    with pytest.raises(RecordingError, match=rf"zero\.json.*{shown}.*zero again") as refused:
        load_baselines(path)
    assert one_line(refused)


@pytest.mark.parametrize("text", [b"", b"[1]", b"NaN", b"1" * 10_000, b"\xff", b"[" * 100_000, None])
def test_files_that_are_no_json_or_not_there(tmp_path, text):
    path = tmp_path / "zero.json"
    if text is not None:
        path.write_bytes(text)
    words = r"zero\.json: cannot be read: No such" if text is None else r"zero\.json"
    with pytest.raises(RecordingError, match=words) as refused:
        load_baselines(path)
    assert one_line(refused)


def test_a_baseline_of_another_order_of_taxels_is_refused(tmp_path):
    orders = {"4": tuple(reversed(range(16)))}
    save_baselines(tmp_path / "zero.json", [made()], orders)
    assert list(load_baselines(tmp_path / "zero.json", orders)) == ["4"]
    with pytest.raises(RecordingError, match="the taxels of sensor 4 lay in another order"):
        load_baselines(tmp_path / "zero.json")
