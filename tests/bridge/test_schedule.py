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


@pytest.mark.parametrize(
    ("off_by_s", "ticks"),
    [  # each tick: the time worked before it, its number, and when it came, in [s]
        ((), [(0.0, 1, 0.01), (0.003, 2, 0.02), (0.0099, 3, 0.03)]),
        ((), [(0.01, 1, 0.01)]),
        ((0.004,), [(0.0, 1, 0.014), (0.0, 2, 0.02)]),
        ((), [(0.0199, 1, 0.0199), (0.0, 2, 0.02)]),
        ((), [(0.0201, 2, 0.0201), (0.0, 3, 0.03)]),
        ((), [(0.0349, 3, 0.0349), (0.0, 4, 0.04)]),
    ],
)
def test_ticks_lie_on_the_grid_however_long_the_work_takes(off_by_s, ticks):
    time = FakeTime(*off_by_s)
    ticker = Ticker(100, time.clock, time.sleep)
    start_ns = time.now_ns
    for work_s, tick, at_s in ticks:
        time.pass_s(work_s)
        assert (ticker.wait(), time.now_ns - start_ns) == (tick, round(at_s * NS_PER_S))


def test_no_rate_drifts():
    time = FakeTime()
    ticker, start_ns = Ticker(59.7544117, time.clock, time.sleep), time.now_ns
    for _ in range(10_000):
        ticker.wait()
    assert abs(time.now_ns - start_ns - 10_000 / 59.7544117 * NS_PER_S) < 2


def test_sleeping_goes_on_until_the_deadline():
    time = FakeTime(-0.5, -0.2)
    assert sleep_until(time.now_ns + NS_PER_S, time.clock, time.sleep) == 6 * NS_PER_S
    assert sleep_until(0, time.clock, time.sleep) == 6 * NS_PER_S
    assert time.slept_s == pytest.approx([1.0, 0.5, 0.2])
