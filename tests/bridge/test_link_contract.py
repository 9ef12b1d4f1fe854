"""The contract of every link, each on a device that is as real as can be."""

import math
import threading
import time

import pytest
from bridge_samples import frames_of, make_counts, read_scans
from link_rigs import DemoRig, GsUsbRig, PythonCanRig, ReplayRig, ServerRig, SlcanRig

from edge.errors import UsageError
from edge.pipeline.cadence import ReadingPace
from edge.pipeline.scan_reader import Source
from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.base import LinkReader
from firmware_bridge.scans.can_id_maps import LAYOUT_A_MAP
from firmware_bridge.scans.slcan_scans import SlcanScans

CAN = [SlcanRig, GsUsbRig, PythonCanRig]
THAT_COME_BACK = [*CAN, ServerRig]
LIVE = [*THAT_COME_BACK, DemoRig]
ALL = [*LIVE, ReplayRig]


@pytest.fixture
def rig(request, tmp_path, monkeypatch):
    rig = request.param(tmp_path, monkeypatch)
    yield rig
    rig.close()


def of(kinds):
    return pytest.mark.parametrize("rig", kinds, indirect=True, ids=lambda kind: kind.__name__)


@of(ALL)
def test_it_gives_scans_in_order_and_counts_them(rig):
    link = rig.link()
    assert (link.name, link.ended) == (rig.name, False)
    with link as entered:
        assert entered is link
        scans = rig.give(link, 5)
        assert (link.kind, link.ended, link.trouble) == (rig.kind, False, None)
    assert {scan.sensor for scan in scans} == {rig.sensor}
    assert [scan.number for scan in scans] == list(range(len(scans))) and all(scan.complete for scan in scans)
    times_ns = [scan.time_ns for scan in scans]
    assert times_ns == sorted(times_ns)
    stamped = [scan for scan in scans if scan.device_ns is not None]
    assert all(scan.device_ns <= scan.time_ns for scan in stamped) and bool(stamped) == (rig.kind != "replay")
    counters = link.counters()
    assert counters["scans"] == len(scans), "they are told when it is closed, too"
    counters["scans"] += 1000
    assert link.counters()["scans"] == len(scans), "they are the caller's own"


@of(ALL)
def test_it_may_be_closed_at_any_time_and_is_not_read_then(rig):
    link = rig.link()
    link.__exit__(None, None, None)
    for _ in range(2):
        with link:
            rig.give(link, 1)
        link.__exit__(None, None, None)
    for closed in () if rig.kind == "replay" else (link, rig.link()):
        with pytest.raises(ValueError, match="with statement"):
            closed.read(0.1)


@of(ALL)
def test_it_is_closed_while_another_thread_waits_for_it(rig):
    link = rig.link()
    source = Source(link)
    with source:
        source.pace = ReadingPace(0.003, 20)
        readers = threading.active_count()
    assert threading.active_count() < readers
    source.close()
    with pytest.raises(UsageError, match="is not open"):
        source.take(0.1)


@of(LIVE)
def test_pulled_out_it_is_lost_at_once_and_every_time(rig):
    with rig.link() as link:
        rig.give(link, 2)
        puller = threading.Timer(0.02, rig.lose)
        puller.start()
        for _ in range(2):
            with pytest.raises(LinkLostError, match=rig.lost) as lost:
                for _ in range(100):  # those of which scans are on their way give them first
                    link.read(10.0)
            assert isinstance(lost.value, ConnectionError) and "\n" not in str(lost.value)
        puller.join()
        assert not link.ended


@of(THAT_COME_BACK)
def test_it_comes_back_by_itself_under_the_name_of_its_sensors(rig):
    with LinkReader(rig.link(prefix="finger/"), math.inf) as link:
        scans, end_s = rig.give(link, 2), time.monotonic() + 60
        for outages in (1, 2):
            rig.lose()
            while link.counters()["outages"] < outages:
                scans += link.read(0.05)
            with pytest.raises(DeviceError, match=rig.away) as refused:
                rig.link().__enter__()
            assert "\n" not in str(refused.value) and not isinstance(refused.value, LinkLostError)
            rig.put_back()
            while link.counters()["reopenings"] < outages:
                assert link.read(0.05) == [] and time.monotonic() < end_s
            scans += rig.give(link, 2)
        notices, counters = link.notices(), link.counters()
        assert link.link.can_ids() == (set() if rig.sensor == "1" else {frame.can_id for frame in frames_of(1)})
    numbers = [scan.number for scan in scans]
    assert numbers == sorted(set(numbers)) and counters["scans"] == len(scans)
    assert {scan.sensor for scan in scans} == {f"finger/{rig.sensor}"}
    assert [(notice.kind, notice.sensors) for notice in notices] == [("lost", "finger/"), ("back", "finger/")] * 2
    assert all(notice.text.startswith("finger: ") and "\n" not in notice.text for notice in notices)
    assert (counters["outages"], counters["reopenings"]) == (2, 2)


@pytest.mark.parametrize(
    ("rig", "step"),
    [(kind, "feed") for kind in THAT_COME_BACK] + [(kind, "begin_anew") for kind in CAN],
    indirect=["rig"],
)
def test_counters_are_of_whole_steps(rig, step, monkeypatch):
    """Else what a reader of the counters adds up would not fit together, though nothing was lost."""
    link, take_step, asked, early = rig.link(), getattr(rig.decoder, step), [], []

    def step_and_be_asked(scans, *piece):
        if not asked:
            asked.append(threading.Thread(target=link.counters))
            asked[0].start()
            asked[0].join(0.1)  # a thread that need not wait for this step is done by then
            early.append(not asked[0].is_alive())
        return take_step(scans, *piece)

    with link:
        rig.give(link, 1)
    monkeypatch.setattr(rig.decoder, step, step_and_be_asked)
    with link:
        rig.give(link, 1)
    asked[0].join()
    assert early == [False], "it was answered in the middle"


@of(CAN)
def test_the_same_frames_make_the_same_scans(rig):
    frames = [frame for pair in zip(frames_of(30), frames_of(30, controller=6, seed=1), strict=True) for frame in pair]
    del frames[700:703], frames[100]
    frames.insert(40, frames[39])
    frames.insert(300, CanFrame(0x004, bytes(8), extended=True))
    frames.insert(301, CanFrame(0x004, b"", remote=True))
    frames.insert(302, CanFrame(0x004, bytes(7)))
    expected = SlcanScans().feed(b"".join(map(encode_frame, frames)), 0)
    with rig.link() as link:
        scans = rig.read(link, frames)
        assert link.read(0.01) == []
        counters = link.counters()
    assert len(scans) == len(expected) >= 55
    for scan, other in zip(scans, expected, strict=True):
        assert (scan.sensor, scan.number) == (other.sensor, other.number)
        assert (scan.counts == other.counts).all() and (scan.renewed == other.renewed).all()
    assert (counters["frames"], counters["foreign"], counters["duplicates"]) == (len(frames), 3, 1)


@of(CAN)
def test_a_scan_comes_with_its_last_frame(rig):
    with rig.link() as link:
        assert rig.read(link, frames_of(1)[:15]) == [] == link.read(0.0)
        speaker = threading.Timer(0.02, rig.hear, frames_of(1)[15:])
        speaker.start()
        (scan,) = read_scans(link, 1)
        speaker.join()
        assert scan.complete


@of(CAN)
def test_half_a_scan_is_forgotten_with_the_link(rig):
    link, frames = rig.link(), frames_of(3)
    for _ in range(2):
        with link:
            assert rig.read(link, frames[:8]) == []
        with link:
            (scan,) = rig.read(link, frames[32:])
            assert (scan.counts == make_counts(3)[2]).all()
    assert link.counters()["abandoned"] == 16


@of(CAN)
def test_triggers_wake_older_controllers(rig):
    with rig.link(model=LAYOUT_A_MAP) as link:
        assert rig.sent(7) == [CanFrame(0x200 | board, b"\7\0") for board in range(1, 8)]
        frames = [CanFrame(0x710 + taxel, bytes((0, 0, 1, 0, 2, 0, 3, 0))) for taxel in range(16)]
        (scan,) = rig.read(link, frames)
        assert scan.sensor == "1" and scan.complete and link.counters()["foreign"] == 0


@of(CAN)
def test_what_lay_there_because_nobody_read_is_marked_old(rig):
    with rig.link() as link:
        rig.give(link, 1)
        rig.hear(*frames_of(2))
        time.sleep(0.1)
        link.fetch()
        assert all(scan.unread_ns > 80_000_000 for scan in read_scans(link, 2))
        end_s = time.monotonic() + 60
        while all(scan.unread_ns for scan in [*link.read(0.0), *rig.give(link, 1)]):
            assert time.monotonic() < end_s, "new ones are old for ever"
