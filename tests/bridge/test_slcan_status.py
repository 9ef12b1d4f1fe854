"""Status of an slcan adapter: its words, what of them is trouble, and when it is asked."""

import pytest

from firmware_bridge.can.slcan_status import (
    ADAPTER_ASKED_NS,
    BUS_ERRORS,
    BUS_OFF,
    FLAGS,
    FRAMES_LOST,
    FRAMES_TO_FORGET,
    INTERVAL_NS,
    MOST_UNANSWERED,
    STATUS_FLAGS,
    AdapterStatus,
    StatusQuestions,
)


def told(*lines: bytes, frames: int = 0) -> AdapterStatus:
    status = AdapterStatus()
    assert all(status.hear(line, frames) for line in lines)
    return status


def counted(status: AdapterStatus) -> dict[str, int]:
    return {name: count for name, count in status.counts.items() if count}


def test_every_flag_by_itself_and_all_together():
    """Lawicel CAN232 manual: 0 receive queue full, 1 transmit queue full, 2 warning, 3 overrun, 5..7 of the bus."""
    assert STATUS_FLAGS == b"F\r"
    names = ["rx_full", "tx_full", "error_warning", "overrun", "-", "error_passive", "arbitration_lost", "bus_error"]
    assert [FLAGS.get(1 << bit, "-") for bit in range(8)] == names
    for bit, name in enumerate(names):
        expected = {"status_answers": 1} | ({f"adapter_{name}": 1} if name != "-" else {})
        assert counted(told(b"F%02X" % (1 << bit))) == expected
    assert set(counted(told(b"Fff", b"F00"))) == {"status_answers", *(f"adapter_{name}" for name in FLAGS.values())}
    assert told(b"Fff", b"F00").counts["status_answers"] == 2


@pytest.mark.parametrize(
    "line", [b"", b"F", b"F0", b"F0G", b"s", b"sb00000", b"sx000000", b"e0", b"e2a", b"e1ab", b"t"]
)
def test_what_is_none_of_these(line):
    status = AdapterStatus()
    assert not status.hear(line, 0) and counted(status) == {} and status.trouble(0) is None


SOON, LATER = 100 + FRAMES_TO_FORGET - 1, 100 + FRAMES_TO_FORGET


@pytest.mark.parametrize(
    ("lines", "frames", "in_silence", "trouble"),
    [
        ([b"sb256256"], 100, False, BUS_OFF),
        ([b"sb256256"], 101, False, None),
        *[([b"sb256256", b"s%c000000" % state], 100, False, None) for state in b"awp"],
        *[([flag], frames, False, FRAMES_LOST) for flag in (b"F01", b"F08") for frames in (100, 10**6)],
        ([b"F08", b"F00"], 100, False, None),
        ([b"F02"], 100, False, None),  # a transmit queue is no loss of ours
        ([b"e1o"], SOON, False, FRAMES_LOST),
        ([b"e1o"], LATER, False, None),
        ([b"e1O"], 100, False, None),
        ([b"e1s"], 100, False, None),
        *[([flag], 100, silent, BUS_ERRORS if silent else None) for flag in (b"F80", b"F20") for silent in (0, 1)],
        ([b"F44"], 100, True, None),
    ],
)
def test_what_is_trouble_and_until_when(lines, frames, in_silence, trouble):
    status = told(*lines, frames=100)
    assert status.trouble(frames, flags_of_a_silence=in_silence) == trouble


MS = 1_000_000
T0 = 10**12


def times_asked(until_ns: int, *, scans=lambda ns: True, answer=lambda status: status.hear(b"F00", 0), refuse=False):
    """Return the times of questions, in [ms] from the opening, with a read every 10 ms."""
    status, refusals = AdapterStatus(), 0
    questions = StatusQuestions(status)
    asked = []
    for ns in range(0, until_ns, 10 * MS):
        if questions.due(int(scans(ns)), refusals, T0 + ns):
            asked.append(ns // MS)
            refusals += refuse
            answer(status)
    return asked


def third():
    """Answer every third question."""
    numbers = iter(range(100))
    return lambda status: next(numbers) % 3 == 0 and status.hear(b"F00", 0)


@pytest.mark.parametrize(
    ("until_s", "how", "asked_ms"),
    [
        (20, {}, [5000, 10_000, 15_000]),
        (12, {"scans": lambda ns: False}, [500, 5500, 10_500]),
        (12, {"scans": lambda ns: ns < 6000 * MS}, [5000, 6490, 11_490]),
        # Half a second apart even if scans come and go.
        (4, {"scans": lambda ns: ns % (600 * MS) == 0}, [500, 1100, 1700, 2300, 2900, 3500]),
        (60, {"answer": lambda status: None}, [5000, 10_000, 15_000]),
        (60, {"answer": lambda status: None, "refuse": True}, [5000]),
        (60, {"refuse": True}, list(range(5000, 60_000, 5000))),  # a BEL beside an answer was of something else
        (60, {"answer": third()}, list(range(5000, 60_000, 5000))),
    ],
)
def test_when_it_is_asked(until_s, how, asked_ms):
    """Seldom while the sensor runs, at once where it is silent, and no more if it does not answer."""
    assert times_asked(until_s * 1000 * MS, **how) == asked_ms and MOST_UNANSWERED == 3


def test_what_was_said_last_does_not_outlive_the_answering():
    status = AdapterStatus()
    questions = StatusQuestions(status)
    assert not questions.due(1, 0, T0)
    assert questions.due(1, 0, T0 + INTERVAL_NS)
    status.hear(b"F08", 0)
    for n in range(2, 10):
        assert status.trouble(0) == (FRAMES_LOST if n <= 2 + MOST_UNANSWERED else None)
        questions.due(1, 0, T0 + n * INTERVAL_NS)


def test_an_answer_is_of_a_silence_only_if_asked_in_it():
    status = AdapterStatus()
    questions = StatusQuestions(status)
    assert not questions.due(1, 0, T0)
    assert not questions.answered_in_silence
    assert questions.due(1, 0, T0 + INTERVAL_NS)
    status.hear(b"F80", 0)
    assert not questions.answered_in_silence, "asked in the midst of scans"
    assert questions.due(0, 0, T0 + INTERVAL_NS + ADAPTER_ASKED_NS)
    assert not questions.answered_in_silence, "not answered yet"
    status.hear(b"F80", 0)
    assert questions.answered_in_silence
    assert questions.due(0, 0, T0 + 2 * INTERVAL_NS + ADAPTER_ASKED_NS)
    assert questions.answered_in_silence, "asking again unsays nothing"
    assert not questions.due(1, 0, T0 + 2 * INTERVAL_NS + ADAPTER_ASKED_NS + 1)
    assert not questions.answered_in_silence, "a scan came"


def test_a_new_opening_is_a_new_chance_for_who_ever_answered():
    for ever in (True, False):
        status = AdapterStatus()
        if ever:
            status.hear(b"F00", 0)
        questions = StatusQuestions(status)
        times = (T0 + n * INTERVAL_NS for n in range(100))
        asked = [questions.due(1, 0, next(times)) for _ in range(10)]
        assert sum(asked) == MOST_UNANSWERED
        questions.reopened()
        assert questions.due(1, 0, next(times)) == ever
