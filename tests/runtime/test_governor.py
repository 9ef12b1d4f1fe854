"""Simulated loads on a simulated clock."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.budgeting.model_choice import Candidate
from edge.budgeting.step_rule import FIRST_WAIT_NS, LONGEST_STEP_NS, LONGEST_WAIT_NS, Governor

LADDER = (
    Candidate("int8", 35.20, 800.0, 1100.0),
    Candidate("float", 35.27, 1000.0, 1400.0),
    Candidate("large", 36.00, 3000.0, 3900.0),
)
BUDGET_US = 1500.0
PERIOD_S = 0.01
FIRST_WAIT_S, LONGEST_STEP_S, LONGEST_WAIT_S = (n / 1e9 for n in (FIRST_WAIT_NS, LONGEST_STEP_NS, LONGEST_WAIT_NS))


class Robot:
    """Patterns at 100 Hz; each takes its rung's median times the load."""

    def __init__(self, rung=1, ladder=LADDER[:2], budget_us=BUDGET_US):
        self.governor = Governor(ladder, rung, budget_us)
        self.now_s = 0.0
        self.steps = []

    def pattern(self, run_time_us):
        step = self.governor.watch(round(self.now_s * 1e9), run_time_us)
        if step is not None:
            self.steps.append((self.now_s, step))
        return step

    def work(self, duration_s, load=1.0):
        """`load` is a factor, or gives one at a time in [s]. Returns the rungs stepped to."""
        before, end_s = len(self.steps), self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            self.now_s += PERIOD_S
            factor = load(self.now_s) if callable(load) else load
            self.pattern(self.governor.present.p50_us * factor)
        return [step.rung for _, step in self.steps[before:]]

    def rest(self, duration_s):
        self.now_s += duration_s


def test_a_load_for_a_second_steps_down_and_its_end_up_again():
    robot = Robot()
    assert robot.work(20) == []
    assert robot.work(0.4, 2.0) == [], "not even half a second"
    assert robot.work(1.0, 2.0) == [0]
    down_s, down = robot.steps[0]
    assert 20.5 <= down_s <= 20.53
    assert (
        down.why == "stepped down from float to int8: budget of 1500 us missed in 51 of 100 patterns of the last second"
    )
    assert robot.work(10, 2.0) == []
    calm_s = robot.now_s
    assert robot.work(10) == [1]
    up_s, up = robot.steps[1]
    # The median of the last second is that of the load for half a second more.
    assert calm_s + FIRST_WAIT_S + 0.4 <= up_s <= calm_s + FIRST_WAIT_S + 0.6
    assert up.why == "stepped up from int8 to float: p99 of 1400 us expected, within 1500 us for 5 s"
    assert robot.work(200) == []


def test_a_second_must_be_full_before_anything_is_said():
    robot = Robot()
    assert robot.work(0.99, 9.0) == []
    assert robot.work(0.03, 9.0) == [0]


@pytest.mark.parametrize("longest_us", [1e4, 1e7])
def test_a_hiccup_is_no_reason(longest_us):
    robot = Robot()
    for _ in range(30):
        robot.work(0.5)
        robot.now_s += longest_us / 1e6
        robot.pattern(longest_us)
    assert robot.steps == []


def test_half_of_the_patterns_may_miss_and_one_more_may_not():
    def alternating(late_of_ten):
        return lambda now_s: 2.0 if round(now_s / PERIOD_S) % 10 < late_of_ten else 1.0

    robot = Robot()
    assert robot.work(30, alternating(5)) == []
    assert robot.work(3, alternating(6)) == [0]


def test_on_the_budget_is_not_over_it():
    assert Robot().work(10, 1.5) == []
    assert Robot().work(10, 1.5001) == [0]


def test_a_ramp_goes_down_the_ladder_rung_by_rung_and_stays_at_the_bottom():
    robot = Robot(rung=2, ladder=LADDER, budget_us=4000)
    assert robot.work(60, lambda now_s: 1 + now_s / 6) == [1, 0]
    assert robot.work(60, 20.0) == []
    assert robot.governor.present.name == "int8"


def test_up_again_rung_by_rung():
    robot = Robot(rung=0, ladder=LADDER, budget_us=4000)
    assert robot.work(20, 1.0) == [1, 2]
    gap_s = robot.steps[1][0] - robot.steps[0][0]
    assert gap_s == pytest.approx(FIRST_WAIT_S, abs=0.1)


def test_no_step_up_where_the_rung_above_would_not_fit():
    robot = Robot(rung=0)
    # int8 fits in its median at 1.5 times, but 1.5 times the 1400 us of float do not.
    assert robot.work(120, 1.5) == []
    assert robot.work(120, 1.12) == []
    assert robot.work(FIRST_WAIT_S + 2, 1.07) == [1], "1500 / 1400"


def test_a_machine_that_is_as_calibrated_within_a_tenth_takes_the_calibrated_figures():
    assert Robot(rung=0, budget_us=1400).work(10, 1.099) == [1]
    assert Robot(rung=0, budget_us=1399).work(10, 1.099) == []
    assert Robot(rung=0, budget_us=1399).work(10, 0.8) == [1], "calibrated on a busy machine"


def test_a_load_that_comes_with_every_step_up_makes_the_wait_double():
    robot = Robot()
    while robot.now_s < 1400:
        robot.work(PERIOD_S, 1.0 if robot.governor.rung == 0 else 2.0)
    ups_s = [now_s for now_s, step in robot.steps if step.rung == 1]
    downs_s = [now_s for now_s, step in robot.steps if step.rung == 0]
    waits_s = [up_s - down_s for down_s, up_s in zip(downs_s, ups_s, strict=False)]
    expected_s = [min(FIRST_WAIT_S * 2**n, LONGEST_WAIT_S) for n in range(len(waits_s))]
    assert waits_s == pytest.approx(expected_s, abs=0.1) and waits_s[-1] == pytest.approx(LONGEST_WAIT_S, abs=0.1)


def test_a_step_up_that_held_a_minute_makes_the_wait_short_again():
    robot = Robot(rung=0)
    robot.work(6)
    robot.work(1.5, 2.0)
    assert robot.work(9.5) == []
    assert robot.work(2) == [1], "doubled to ten seconds"
    robot.work(61)
    robot.work(1.5, 2.0)
    assert robot.work(6) == [1]


def test_the_first_step_down_is_nobodys_fault():
    robot = Robot()
    robot.work(2)
    assert robot.work(1, 2.0) == [0]
    assert robot.work(6) == [1]


def test_idle_time_is_no_evidence():
    robot = Robot()
    robot.work(0.3, 2.0)
    robot.rest(3600)
    assert robot.work(0.3, 2.0) == [], "0.3 s twice, and a pause that counts as a tenth of a second"
    robot.work(0.5, 2.0)
    assert robot.governor.rung == 0
    robot.rest(3600)
    assert robot.work(4.5) == [], "five seconds of room are five seconds of patterns"
    assert robot.work(1.5) == [1]


def test_short_taps_are_evidence_together():
    robot = Robot()
    taps = 0
    while not robot.steps and taps < 100:
        robot.rest(2)
        robot.work(0.2, 2.0)
        taps += 1
    assert 3 <= taps <= 6


def test_patterns_far_apart_need_ten_for_a_second():
    robot = Robot()
    taken = 0
    while not robot.steps:
        robot.rest(10)
        robot.pattern(9000)
        taken += 1
    assert taken == round(1 / LONGEST_STEP_S) + 1


def test_time_that_runs_backwards_or_stands_still_is_no_time():
    robot = Robot()
    for _ in range(1000):
        robot.pattern(9000)
        robot.now_s -= 0.005
    assert robot.steps == []
    assert robot.work(1.1, 9.0) == [0]


@pytest.mark.parametrize("rung", [-1, 2])
def test_no_such_rung(rung):
    with pytest.raises(IndexError, match=rf"rung {rung}, expected one of 0 to 1"):
        Governor(LADDER[:2], rung, BUDGET_US)


@settings(deadline=None)
@given(
    st.integers(1, 3),
    st.floats(500, 5000),
    st.lists(
        st.tuples(st.integers(1, 400), st.floats(0.001, 3), st.floats(0.3, 6) | st.just(1.0)), min_size=1, max_size=12
    ),
)
def test_never_off_the_ladder_one_rung_at_a_time_never_twice_within_a_second(rungs, budget_us, phases):
    robot = Robot(rung=rungs - 1, ladder=LADDER[:rungs], budget_us=budget_us)
    for patterns, period_s, load in phases:
        for _ in range(patterns):
            robot.now_s += period_s
            before = robot.governor.rung
            step = robot.pattern(robot.governor.present.p50_us * load)
            assert 0 <= robot.governor.rung < rungs
            assert robot.governor.rung == (before if step is None else step.rung)
            assert step is None or abs(step.rung - before) == 1
    times_s = [now_s for now_s, _ in robot.steps]
    assert all(later - earlier >= 1 - 1e-6 for earlier, later in itertools.pairwise(times_s))
