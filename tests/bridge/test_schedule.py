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
    ("off_by_s", "ticks", "late", "skipped"),
    [  # each tick: the time worked before it, its number, and when it came, in [s]
        ((), [(0.0, 1, 0.01), (0.003, 2, 0.02), (0.009, 3, 0.03), (0.0099, 4, 0.04)], 0, 0),
        ((), [(0.01, 1, 0.01)], 0, 0),
        ((0.004,), [(0.0, 1, 0.014), (0.0, 2, 0.02)], 0, 0),
        ((), [(0.013, 1, 0.013), (0.0, 2, 0.02)], 1, 0),
        ((), [(0.0199, 1, 0.0199), (0.0, 2, 0.02)], 1, 0),
        ((), [(0.0201, 2, 0.0201), (0.0, 3, 0.03)], 1, 1),
        ((), [(0.0349, 3, 0.0349), (0.0, 4, 0.04)], 1, 2),
        ((), [(0.7, 70, 0.7), (0.0, 71, 0.71)], 1, 69),
    ],
)
def test_ticks_lie_on_the_grid_however_long_the_work_takes(off_by_s, ticks, late, skipped):
    time = FakeTime(*off_by_s)
    ticker = Ticker(100, time.clock, time.sleep)
    start_ns = time.now_ns
    for work_s, tick, at_s in ticks:
        time.pass_s(work_s)
        assert (ticker.wait(), time.now_ns - start_ns) == (tick, round(at_s * NS_PER_S))
    assert (ticker.late, ticker.skipped) == (late, skipped)


@pytest.mark.parametrize("rate_hz", [59.7544117, 0.5])
def test_no_rate_drifts(rate_hz):
    time = FakeTime()
    ticker = Ticker(rate_hz, time.clock, time.sleep)
    start_ns = time.now_ns
    for _ in range(10_000):
        ticker.wait()
    assert abs(time.now_ns - start_ns - 10_000 / rate_hz * NS_PER_S) < 2
    assert ticker.deadline_ns(0) == start_ns


def test_sleeping_goes_on_until_the_deadline():
    time = FakeTime(-0.5, -0.2)
    assert sleep_until(time.now_ns + NS_PER_S, time.clock, time.sleep) == 6 * NS_PER_S
    assert time.slept_s == pytest.approx([1.0, 0.5, 0.2])
    assert sleep_until(0, time.clock, time.sleep) == 6 * NS_PER_S
    assert len(time.slept_s) == 3


@pytest.mark.parametrize("rate_hz", [0, -1, float("nan"), float("inf")])
def test_a_rate_is_a_positive_number(rate_hz):
    with pytest.raises(ValueError, match="positive"):
        Ticker(rate_hz)
