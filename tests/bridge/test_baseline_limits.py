"""Limits of zeroing and of a baseline's file: the last value that is taken, and the first that is not."""

import numpy as np
import pytest
from edge_samples import BASELINE, REST

from firmware_bridge.errors import BaselineRefusedError, RecordingError
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline, BaselineEstimator, load_baselines, save_baselines


def zeroed(moved: np.ndarray, axis: int = 2) -> Baseline | None:
    """The baseline of a pad one of whose taxels moved so, in [counts] a scan, and no other."""
    series, estimator = ScanSeries("4", USPA44), BaselineEstimator(min_scans=len(moved))
    baseline = None
    for number, counts in enumerate(moved):
        readings = REST.copy()
        readings[0, 0, 0] += number % 2  # so that no scan is sent again
        readings[axis, 3, 1] += counts
        baseline = estimator.push(series.close(readings, number))
    return baseline


@pytest.mark.parametrize("counts", [100, -100])
def test_one_scan_in_twenty_may_be_far_off_and_one_more_is_motion(counts):
    assert zeroed(np.where(np.arange(100) % 20 == 7, counts, 0)) is not None
    with pytest.raises(BaselineRefusedError, match=r"taxel \(3, 1\) z moved by 100 counts"):
        zeroed(np.where((np.arange(100) % 20 == 7) | (np.arange(100) == 50), counts, 0))


@pytest.mark.parametrize(("axis", "name", "limit"), [(0, "x", 15), (1, "y", 15), (2, "z", 25)])
def test_shear_has_a_limit_of_its_own(axis, name, limit):
    wobble = np.arange(100) % 10 == 0
    assert zeroed(limit * wobble, axis) is not None
    with pytest.raises(BaselineRefusedError, match=rf"taxel \(3, 1\) {name} moved by {limit + 1} counts"):
        zeroed((limit + 1) * wobble, axis)


@pytest.mark.parametrize("at_the_end", [True, False])
def test_creep_is_what_lies_between_the_first_third_and_the_last(at_the_end):
    """The median of 33 scans moves with the seventeenth of them."""
    order = np.arange(99) if at_the_end else np.arange(99)[::-1]
    assert zeroed(np.where(order >= 99 - 16, 11, 0)) is not None
    with pytest.raises(BaselineRefusedError, match=r"taxel \(3, 1\) z crept by 11 counts"):
        zeroed(np.where(order >= 99 - 17, 11, 0))
    assert zeroed(np.where(order >= 99 - 17, 10, 0)) is not None


def test_a_file_of_a_mebibyte_is_read_and_a_larger_one_is_not(tmp_path):
    path = tmp_path / "zero.json"
    save_baselines(path, [BASELINE])
    path.write_text(path.read_text().ljust(1 << 20))
    assert list(load_baselines(path)) == ["4"]
    path.write_text(path.read_text() + " ")
    with pytest.raises(RecordingError, match="larger than"):
        load_baselines(path)
