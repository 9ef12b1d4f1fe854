import contextlib
import io

import pytest
from edge_samples import ListSink, make_scan
from sink_samples import RUN, Terminal, make_results

from edge.errors import SinkClosedError, SinkError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.sinks.event_printer import MessageSink
from edge.sinks.fan_out import Fan
from edge.sinks.jsonl import JsonLinesSink
from firmware_bridge.errors import LinkLostError


class TestFan:
    class Failing(ListSink):
        def __init__(self, error):
            super().__init__(on_write=self.fail)
            self.error = error

        def fail(self, result):
            if self.error is not None:
                raise self.error

    def test_trouble_that_lasts_is_told_once_and_again_when_it_comes_back(self):
        class Troubled(ListSink):
            trouble = None

        now_ns, told = [0], []
        fan, bad, good = Fan(told.append, lambda: now_ns[0]), Troubled(), ListSink()
        fan.add(bad)
        fan.add(good)
        for time_ms, trouble in ((100, "nobody"), (600, "nobody"), (1200, "nobody"), (1800, None), (2400, "nobody")):
            now_ns[0], bad.trouble = time_ms * 1_000_000, trouble
            fan.write(make_results(1)[0], RUN)
            assert fan.trouble == trouble
        assert [(event.time_ns, event.kind, event.text) for event in told] == [
            (time_ns, "sink", "nobody") for time_ns in (600_000_000, 2_400_000_000)
        ]
        assert good.events == told

    def test_one_that_fails_while_nothing_comes_is_given_up_too(self):
        fan, good, bad = Fan(lambda event: None), ListSink(), ListSink()
        bad.wait = lambda: self.Failing(SinkError("disk full")).fail(None)
        fan.add(bad)
        fan.add(good)
        fan.write(make_results(1)[0], RUN)
        fan.wait()
        fan.wait()
        assert good.waits == 2 and bad.closed and [event.kind for event in good.events] == ["sink"]
        assert good.told_counters == [RUN]  # and of what was counted nothing is forgotten

    def test_two_that_fail_together_leave_the_third(self):
        for acts in (
            lambda fan: fan.write(make_results(1)[0], RUN),
            lambda fan: fan.tell(Event(0, "lost", None, ""), RUN),
        ):
            fan, good = Fan(lambda event: None), ListSink()
            full = [JsonLinesSink("/dev/full") for _ in range(2)]
            for sink in (*full, good):
                fan.add(sink)
            acts(fan)
            fan.write(make_results(1)[0], RUN)
            assert len(good.results) >= 1 and len(fan.failures) == 2

    def test_what_ended_the_run_is_told_rather_than_a_sink_that_failed_before(self):
        fan = Fan(lambda event: None)
        for sink in (self.Failing(SinkError("disk full")), ListSink()):
            fan.add(sink)
        fan.write(make_results(1)[0], RUN)
        with pytest.raises(LinkLostError, match="gone"), contextlib.ExitStack() as closing:
            closing.callback(fan.close)
            raise LinkLostError("gone")

    def test_readers_that_go_are_an_ordinary_end_of_the_last_sink_alone(self):
        fan = Fan(lambda event: None)
        first, second = (self.Failing(SinkClosedError(name)) for name in "ab")
        second.error = None
        fan.add(first)
        fan.add(second)
        fan.write(make_results(1)[0], RUN)
        second.error = SinkClosedError("b")
        with pytest.raises(SinkClosedError, match="b"):
            fan.write(make_results(1)[0], RUN)
        fan.close()

    def test_one_that_cannot_be_finished_hinders_no_other(self):
        class Unfinished(ListSink):
            def close(self):
                raise SinkError("no room")

        fan, good = Fan(lambda event: None), ListSink()
        for sink in (Unfinished(), good):
            fan.add(sink)
        with pytest.raises(SinkError, match="no room"):
            fan.close()
        assert good.closed


@pytest.mark.parametrize("terminal", [True, False])
def test_events_are_lines_on_stderr(terminal):
    stream = Terminal() if terminal else io.StringIO()
    MessageSink(stream).tell(Event(0, "lost", None, "the cable is out"), {})
    assert stream.getvalue() == ("\r\x1b[K" if terminal else "") + "edge-sr: the cable is out\n"


def test_the_events_of_a_result_are_lines():
    stream = io.StringIO()
    messages = MessageSink(stream)
    for number, texts in enumerate([[], ["zeroing refused", "zeroed; again"]]):
        events = tuple(Event(number, "refused", None, text) for text in texts)
        messages.write(Result(make_scan(number), "device", "tiny", "idle", events=events), {})
    assert stream.getvalue() == "edge-sr: zeroing refused\nedge-sr: zeroed; again\n"
