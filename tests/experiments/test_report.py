import numpy as np
import pytest

from train.report import Report, bootstrap_interval


def test_frames_of_one_tap_are_not_independent():
    """Sixteen copies of each value tell no more than one: the interval is that of the taps, not of the frames."""
    values = np.random.default_rng(1).normal(30, 2, 72)
    alone = bootstrap_interval(values, np.arange(72))
    assert bootstrap_interval(np.repeat(values, 16), np.repeat(np.arange(72), 16)) == pytest.approx(alone)
    assert alone[1] - alone[0] == pytest.approx(2 * 1.96 * values.std() / np.sqrt(72), rel=0.1)
    assert alone[0] < values.mean() < alone[1]


def test_the_interval_holds_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(2)
    held = 0
    for run in range(200):
        tap = np.repeat(rng.normal(0, 1, 40), 4) + 0.1 * rng.normal(size=160)
        low, high = bootstrap_interval(tap, np.repeat(np.arange(40), 4), seed=run)
        held += low <= 0 <= high
    assert 0.88 < held / 200 < 0.99


def test_a_report_is_a_page_with_tables(tmp_path):
    report = Report("mine", tmp_path / "reports", __file__)
    report.say("What was done.")
    report.table([{"method": "a", "dB": 31.234567}, {"method": "b", "extra": 2}], "All methods.")
    page = report.write().read_text()
    assert page.startswith("# mine\n") and 'command = "python' in page and "quick run" not in page
    assert page.index("What was done.") < page.index("All methods.\n\n| method | dB | extra |")
    assert "| a | 31.23 | - |\n| b | - | 2 |" in page
    assert "quick run" in Report("mine", tmp_path, __file__, quick=True).write().read_text()
