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
    names = ["rx_full", "tx_full", "error_warning", "overrun", "-", "error_passive", "arbitration_lost", "bus_error"]
    assert [FLAGS.get(1 << bit, "-") for bit in range(8)] == names
    for bit, name in enumerate(names):
        expected = {"status_answers": 1} | ({f"adapter_{name}": 1} if name != "-" else {})
        assert counted(told(b"F%02X" % (1 << bit))) == expected
    assert set(counted(told(b"Fff", b"F00"))) == {"status_answers", *(f"adapter_{name}" for name in FLAGS.values())}
    assert told(b"Fff", b"F00").answers == 2


def test_states_and_errors_are_counted_by_sort():
    status = told(b"sa000000", b"sw096000", b"sp128000", b"sb256256", b"e3oOs", b"e2fa")
    assert counted(status) == {
        "status_lines": 6,
        "adapter_error_active": 1,
        "adapter_error_warning": 1,
        "adapter_error_passive": 1,
        "adapter_bus_off": 1,
        "adapter_overrun": 1,
        "adapter_tx_overrun": 1,
        "adapter_stuff_error": 1,
        "adapter_form_error": 1,
        "adapter_ack_error": 1,
    }


@pytest.mark.parametrize(
    "line", [b"", b"F", b"F0", b"F0G", b"s", b"sb00000", b"sx000000", b"e0", b"e2a", b"e1ab", b"t"]
)
def test_what_is_none_of_these(line):
    status = AdapterStatus()
    assert not status.hear(line, 0) and counted(status) == {} and status.trouble(0) is None


def test_bus_off_is_trouble_until_another_state_or_a_frame():
    status = told(b"sb256256", frames=7)
    assert status.trouble(7) == BUS_OFF and "bus-off" in BUS_OFF and "termination" in BUS_OFF
    assert status.trouble(8) is None
    for state in b"awp":
        assert told(b"sb256256", b"s%c000000" % state).trouble(0) is None


def test_flags_of_lost_frames_are_trouble_until_they_are_clear():
    for flag in (b"F01", b"F08"):
        status = told(flag, frames=3)
        assert status.trouble(3) == status.trouble(10**6) == FRAMES_LOST
        assert status.hear(b"F00", 10**6) and status.trouble(10**6) is None
    assert told(b"F02").trouble(0) is None, "a transmit queue is no loss of ours"


def test_an_overrun_told_by_itself_is_trouble_for_a_while():
    status = told(b"e1o", frames=100)
    assert status.trouble(100 + FRAMES_TO_FORGET - 1) == FRAMES_LOST
    assert status.trouble(100 + FRAMES_TO_FORGET) is None
    assert told(b"e1O").trouble(0) is None and told(b"e1s").trouble(0) is None


def test_errors_on_the_bus_are_trouble_only_in_a_silence():
    for flag in (b"F80", b"F20"):
        assert told(flag).trouble(0) is None
        assert told(flag).trouble(0, flags_of_a_silence=True) == BUS_ERRORS
    assert told(b"F44").trouble(0, flags_of_a_silence=True) is None


def test_what_is_forgotten():
    status = told(b"F08")
    status.forget()
    assert status.trouble(0) is None and counted(status)["adapter_overrun"] == 1


# When to ask.

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


def silent(status):
    return None


def test_a_running_sensor_is_asked_about_seldom():
    assert times_asked(20_000 * MS) == [5000, 10_000, 15_000]


def test_a_silent_one_is_asked_about_at_once():
    assert times_asked(12_000 * MS, scans=lambda ns: False) == [500, 5500, 10_500]
    gone = times_asked(12_000 * MS, scans=lambda ns: ns < 6000 * MS)
    assert gone == [5000, 6490, 11_490]
    # Half a second apart even if scans come and go.
    hiccups = times_asked(4000 * MS, scans=lambda ns: ns % (600 * MS) == 0)
    assert hiccups == [500, 1100, 1700, 2300, 2900, 3500]


def test_who_does_not_answer_is_asked_no_more():
    assert len(times_asked(60_000 * MS, answer=silent)) == MOST_UNANSWERED
    assert len(times_asked(60_000 * MS, answer=silent, refuse=True)) == 1
    assert len(times_asked(60_000 * MS, refuse=True)) > 5, "a BEL beside an answer was of something else"


def test_one_answer_in_time_keeps_the_asking():
    count = iter(range(100))
    asked = times_asked(100_000 * MS, answer=lambda status: next(count) % 3 == 0 and status.hear(b"F00", 0))
    assert len(asked) == 19


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


def test_a_new_opening_is_a_new_chance_for_who_has_ever_answered():
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


def test_the_command():
    assert STATUS_FLAGS == b"F\r"
