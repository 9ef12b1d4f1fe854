import pytest

from firmware_bridge.schedule import NS_PER_S, Ticker, sleep_until


class FakeTime:
    """A clock that only sleeping moves on, later or earlier than asked for."""

    def __init__(self, *off_by_s: float) -> None:
        self.now_ns = 5 * NS_PER_S
        self.slept_s: list[float] = []
        self._off_by_s = list(off_by_s)

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, time_s: float) -> None:
        self.slept_s.append(time_s)
        self.pass_s(time_s + (self._off_by_s.pop(0) if self._off_by_s else 0.0))

    def pass_s(self, time_s: float) -> None:
        self.now_ns += round(time_s * NS_PER_S)


def test_ticks_lie_on_the_grid_however_long_the_work_takes():
    time = FakeTime()
    ticker = Ticker(100, time.clock, time.sleep)
    start_ns = time.now_ns
    for number, work_s in enumerate((0.0, 0.003, 0.009, 0.0099), 1):
        time.pass_s(work_s)
        assert ticker.wait() == number
        assert time.now_ns == start_ns + number * 10_000_000
    assert (ticker.late, ticker.skipped) == (0, 0)


def test_a_late_sleep_does_not_move_the_ticks_after_it():
    time = FakeTime(0.004, 0.0)
    ticker = Ticker(100, time.clock, time.sleep)
    start_ns = time.now_ns
    ticker.wait()
    assert time.now_ns == start_ns + 14_000_000
    ticker.wait()
    assert time.now_ns == start_ns + 20_000_000
    assert (ticker.late, ticker.skipped) == (0, 0)


def test_a_late_tick_is_counted_and_the_next_is_on_the_grid():
    time = FakeTime()
    ticker = Ticker(100, time.clock, time.sleep)
    start_ns = time.now_ns
    time.pass_s(0.013)
    assert ticker.wait() == 1
    assert time.now_ns == start_ns + 13_000_000 and time.slept_s == []
    assert (ticker.late, ticker.skipped) == (1, 0)
    assert ticker.wait() == 2
    assert time.now_ns == start_ns + 20_000_000
    assert (ticker.late, ticker.skipped) == (1, 0)


@pytest.mark.parametrize(
    ("passed_s", "tick", "skipped"), [(0.0199, 1, 0), (0.0201, 2, 1), (0.0349, 3, 2), (0.7, 70, 69)]
)
def test_an_overrun_skips_whole_ticks_and_comes_back_to_the_grid(passed_s, tick, skipped):
    time = FakeTime()
    ticker = Ticker(100, time.clock, time.sleep)
    start_ns = time.now_ns
    time.pass_s(passed_s)
    assert ticker.wait() == tick
    assert (ticker.late, ticker.skipped) == (1, skipped)
    assert ticker.wait() == tick + 1
    assert time.now_ns == start_ns + (tick + 1) * 10_000_000


def test_exactly_on_time_is_not_late():
    time = FakeTime()
    ticker = Ticker(100, time.clock, time.sleep)
    time.pass_s(0.01)
    assert ticker.wait() == 1
    assert (ticker.late, time.slept_s) == (0, [])


def test_a_rate_that_is_no_whole_number_of_nanoseconds_does_not_drift():
    time = FakeTime()
    ticker = Ticker(59.7544117, time.clock, time.sleep)
    start_ns = time.now_ns
    for _ in range(100_000):
        ticker.wait()
    assert abs(time.now_ns - start_ns - 100_000 / 59.7544117 * NS_PER_S) < 2
    assert ticker.deadline_ns(0) == start_ns


def test_sleeping_goes_on_until_the_deadline():
    time = FakeTime(-0.5, -0.2)
    assert sleep_until(time.now_ns + NS_PER_S, time.clock, time.sleep) == 6 * NS_PER_S
    assert time.slept_s == pytest.approx([1.0, 0.5, 0.2])
    assert sleep_until(0, time.clock, time.sleep) == 6 * NS_PER_S
    assert len(time.slept_s) == 3


def test_a_rate_may_be_less_than_one():
    time = FakeTime()
    ticker = Ticker(0.5, time.clock, time.sleep)
    ticker.wait()
    assert time.slept_s == [2.0]


@pytest.mark.parametrize("rate_hz", [0, -1, float("nan"), float("inf")])
def test_a_rate_is_a_positive_number(rate_hz):
    with pytest.raises(ValueError, match="positive"):
        Ticker(rate_hz)
