"""Run times on a clock of its own, the front, and the cost of a scan's way against an earlier commit."""

import re
import shutil

import hot_path
import numpy as np
import program_cost
import pytest
from hot_path import ROOT, compare, main, report, slower
from program_cost import Ratio, ratio_of
from program_cost import main as cost

from edge.bench.command import front
from edge.bench.timing import back_to_back, paced


class Clock:
    """Goes on when someone sleeps or works."""

    def __init__(self):
        self.now_ns = 1_000_000

    def __call__(self):
        return self.now_ns

    def sleep(self, time_s):
        self.now_ns += round(time_s * 1e9)

    def work(self, *took_ms):
        """Return a run that takes these times in turn, then always the last one, and the list of its numbers."""
        numbers = []

        def run(number):
            numbers.append(number)
            self.now_ns += round(1e6 * took_ms[min(len(numbers), len(took_ms)) - 1])

        return run, numbers


def pace(clock, run, ticks, rate_hz=100.0):
    return paced(run, rate_hz, ticks, clock, clock.sleep, cpu_clock=lambda: clock.now_ns // 4)


@pytest.mark.parametrize(
    ("took_ms", "ticks", "done", "missed"),
    [
        ((2,), 20, range(1, 21), 0),
        ((2, 12, 2), 10, range(1, 11), 1),  # not done when the next is due
        ((2, 35, 2), 10, [1, 2, 5, 6, 7, 8, 9, 10], 3),  # due at 20 ms, done at 55: 3 and 4 have passed, 5 begins late
        ((60,), 30, [1, 7, 13, 19, 25], 30),
    ],
)
def test_ticks_whose_run_is_not_done_in_time_are_missed(took_ms, ticks, done, missed):
    clock = Clock()
    run, numbers = clock.work(*took_ms)
    found = pace(clock, run, ticks)
    assert (numbers, found.missed, found.ticks, found.times.runs) == ([*done], missed, ticks, len(numbers))
    assert found.cpu_percent == pytest.approx(25)
    assert found.times.max_us == 1e3 * max(took_ms)


def test_a_machine_that_stands_still_from_the_first_still_gives_a_figure():
    clock = Clock()
    run, numbers = clock.work(1)
    asked = []

    def stalls():
        asked.append(clock.now_ns)
        clock.now_ns += 1_000_000_000 * (len(asked) == 3)  # before the first tick is waited for
        return clock.now_ns

    found = paced(run, 100.0, 10, stalls, clock.sleep, cpu_clock=lambda: 0)
    assert (found.times.runs, numbers) == (1, [10])
    assert found.missed == 10


@pytest.mark.parametrize(
    ("took_ms", "most", "runs"), [(1, 3000, 2000), (0.1, 3000, 3000), (200, 3000, 90), (200, 10, 10)]
)
def test_back_to_back_is_as_many_runs_as_fit(took_ms, most, runs):
    clock = Clock()
    run, _ = clock.work(took_ms)
    found = back_to_back(run, most, clock)
    assert found.runs == runs
    assert found.p50_us == took_ms * 1000


def test_the_front_is_who_is_not_beaten():
    points = [(9.0, 100.0), (5.0, 60.0), (2.0, 700.0), (2.0, 800.0), (1.9, 900.0), (5.0, 60.0)]
    assert front(points) == [False, True, True, False, True, True]


def test_a_way_that_takes_longer_than_the_one_before_is_red(tmp_path, limits, capsys):
    """The tree before is this one, without the work that the change adds to each scan."""
    for package in ("edge", "firmware_bridge"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    changed = tmp_path / "firmware_bridge/scans/slcan_scans.py"
    text = changed.read_text()
    begin = "        scans: list[Scan] = []\n"
    assert text.count(begin) == 1
    changed.write_text(text.replace(begin, f"{begin}        sum(range(40_000))\n"))
    limits(hot_path, BLOCKS=3)
    ratio, took_us = compare(tmp_path, ROOT, pairs=1)["at rest"]
    assert slower(ratio) and took_us > 0
    assert (
        report({"at rest": (ratio, took_us)}, "HEAD~1") == 1 and ": more than a tenth slower" in capsys.readouterr().out
    )
    assert not slower(Ratio(1.05, 1.04, 1.06)) and not slower(Ratio(1.2, 0.9, 1.4))


def test_a_commit_that_cannot_be_run_is_named_and_is_not_red(capsys):
    assert main(["no-such-commit"]) == 0
    assert "no-such-commit: fatal" in capsys.readouterr().out


def test_pairs_are_drawn_together_so_that_what_meets_both_cancels():
    weather = np.random.default_rng(3).uniform(1, 3, 30)
    paired = ratio_of(2 * weather, weather)
    assert (paired.ratio, paired.low, paired.high) == pytest.approx((2, 2, 2)) and str(paired) == "2 (2..2)"


def test_an_interval_holds_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(4)
    found = [ratio_of(rng.normal(12, 1, 30), rng.normal(10, 1, 30)) for _ in range(60)]
    assert 50 <= sum(one.low <= 1.2 <= one.high for one in found) < 60


def test_the_cost_of_the_program_is_a_line_for_rest_and_contact_of_each_tree(limits, capsys):
    limits(program_cost, SETTLE_S=0.5, ROUNDS=1)
    assert cost(["--round-s", "0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["at rest, 1 sensors, now", "in contact, 1 sensors, now"]
    assert all(float(re.search(r"cpu_percent ([\d.]+)", line)[1]) > 0 for line in lines)
    p50_us = re.search(r"p50_us ([\d.e+]+)", lines[1])  # none where a busy machine lost frames
    assert p50_us is None or float(p50_us[1]) > 50
