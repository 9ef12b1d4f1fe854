"""Faults by themselves, and the truth that is kept of them against a decoder that knows of neither."""

import random
from collections import Counter
from itertools import pairwise, takewhile

import numpy as np
import pytest
from bridge_samples import make_counts
from fault_frames import FRAME_FAULTS, READ, BusFrame
from fault_injector import BURST_S, Injector
from fault_lines import LINE_FAULTS, Piece
from fault_stretches import CALM_S, LINK_FAULTS, NAMES, Stretch, mixture, parse_stretches
from fault_truth import FATES, ROW, Truth
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.emulation.pty_port import PseudoPort
from firmware_bridge.emulation.xela_controller import Controller, bus_timeline
from firmware_bridge.recording.tracks import Track
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.slcan_scans import SlcanScans

CYCLES = 100
BUS = [
    Controller(Track("4", make_counts(CYCLES, 1), None), 4, 100.0),
    Controller(Track("6", make_counts(CYCLES, 2), None), 6, 100.0),
]
FRAMES = 2 * 16 * CYCLES


class Played:
    """A second of two sensors through faults into the decoder, cut anywhere."""

    def __init__(self, faults: str, seed: int = 0, longest_chunk: int = 500):
        rows: list[bytes] = []
        self.truth = Truth(rows.append)
        self.injector = Injector(parse_stretches(faults, seed), self.truth, seed)
        self.bus: list[BusFrame] = []
        self.pieces: list[Piece] = []
        self.reader = SlcanScans()
        self.truth.open_channel()
        for time_s, frame in bus_timeline(BUS, jitter_s=0.0, seed=seed, loop=False):
            for sent in self.injector.disturb(time_s, frame):
                self.bus.append(sent)
                if sent.lost:
                    self.truth.lose(sent, 0)
                else:
                    self.pieces += self.injector.corrupt(encode_frame(sent.frame), sent)
        for piece in self.pieces:
            self.truth.hand_on(piece, len(piece.data), 0, 0)
        self.truth.settle(0)
        self.told = np.frombuffer(b"".join(rows), dtype=ROW)
        self.scans = []
        chunks, text, at = random.Random(seed), b"".join(piece.data for piece in self.pieces), 0
        while at < len(text):
            step = chunks.randint(1, longest_chunk)
            self.scans += self.reader.feed(text[at : at + step], int(1e7))
            at += step

    def agrees(self) -> bool:
        """Return True where the reader counted what it must by the truth."""
        counted, told = self.reader.counters(), self.truth.counters()
        counted["bad_lines"] += counted["non_ascii_lines"]
        counted["skipped_bytes"] += self.reader.decoder.pending_bytes
        told["skipped_bytes"] += self.truth._pending
        return told == {name: counted[name] for name in told}


def test_without_faults_nothing_happens():
    played = Played("lost@5+1")
    assert played.truth.fates == Counter(intact=FRAMES) and played.agrees()
    assert len(played.scans) == 2 * CYCLES and all(scan.complete for scan in played.scans)
    assert played.truth.counters() == {
        "frames": FRAMES,
        "foreign": 0,
        "bad_lines": 0,
        "skipped_bytes": 0,
        "duplicates": 0,
    }


@pytest.mark.parametrize("name", [*FRAME_FAULTS, *LINE_FAULTS])
def test_each_fault_strikes_and_every_frame_has_a_fate(name):
    played = Played(f"{name}={'.2' if name in LINE_FAULTS else ''}@.2+.5")
    assert played.injector.begun == Counter({name: 1})
    assert played.agrees()
    struck = played.truth.fates.total() - played.truth.fates["intact"]
    assert played.truth.noise if name == "garbage" else struck
    assert len(played.told) == played.truth.fates.total()
    times = played.told["bus_us"][played.told["fate"] > 0]
    assert not times.size or 200_000 <= times.min() <= times.max() < 710_000
    cycles = played.told[~np.isin(played.told["fate"], [FATES.index("repeated"), FATES.index("foreign")])]
    assert Counter(cycles["can_id"].tolist()) == dict.fromkeys(
        {can_id for can_id, (sensor, _) in USPA44_MAP.taxels.items() if sensor in ("4", "6")}, CYCLES
    )


@given(
    st.lists(
        st.tuples(st.sampled_from([*FRAME_FAULTS, *LINE_FAULTS]), st.integers(0, 90), st.integers(1, 60)),
        min_size=1,
        max_size=8,
    ),
    st.integers(0, 2**32),
    st.integers(1, 1000),
)
@settings(deadline=None, max_examples=15)
def test_any_faults_at_once_are_accounted_for(stretches, seed, longest_chunk):
    parts = [
        f"{name}{'=.3' if name in LINE_FAULTS else ''}@{start / 100}+{long / 100}" for name, start, long in stretches
    ]
    assert Played(",".join(parts), seed, longest_chunk).agrees()


def fates(played: Played, sensor: str, taxel: int) -> Counter[str]:
    can_id = next(can_id for can_id, place in USPA44_MAP.taxels.items() if place == (sensor, taxel))
    return Counter(FATES[row["fate"]] for row in played.told[played.told["can_id"] == can_id])


def test_one_taxel_is_dead_and_no_other():
    played = Played("dead=6.11@.2+.5")
    assert fates(played, "6", 11) == Counter(intact=50, dead=50)
    assert played.truth.fates == Counter(intact=FRAMES - 50, dead=50)


def test_a_stuck_taxel_says_the_same_for_ever():
    played = Played("stuck=4.3@.2+.5")
    assert fates(played, "4", 3) == Counter(intact=51, stuck=49)
    still = [scan.number for scan in played.scans if scan.sensor == "4" and not scan.renewed[0, 3]]
    assert still == list(range(21, 70))


def test_a_finger_falls_silent():
    played = Played("silent=6@.2+.5")
    assert played.truth.fates == Counter(intact=FRAMES - 16 * 50, silent=16 * 50)
    assert Counter(scan.sensor for scan in played.scans) == Counter({"4": 100, "6": 50})


def test_whole_scans_vanish():
    played = Played("vanished=.5@.2005+.5005")
    gone = played.told[played.told["fate"] == FATES.index("vanished")]
    per_cycle = Counter(zip((gone["can_id"] & 15).tolist(), gone["cycle"].tolist(), strict=True))
    assert set(per_cycle.values()) == {16} and 20 < len(per_cycle) < 80
    assert all(scan.complete for scan in played.scans) and len(played.scans) == 200 - len(per_cycle)


def test_a_bus_that_is_off_carries_nothing():
    played = Played("bus-off@.2+.5,repeated=1@.2+.5")
    assert played.truth.fates == Counter({"intact": FRAMES - 1600, "bus-off": 1600})


def test_reordered_frames_come_all_and_at_once():
    played = Played("reordered=.3@0+2")
    assert played.truth.fates.keys() == {"intact", "reordered"} and len(played.bus) == FRAMES
    times = [sent.time_s for sent in played.bus]
    assert sorted(times) != times and max(a - b for a, b in pairwise(times)) < 0.02


def test_a_held_frame_is_freed_when_its_fault_ends():
    injector = Injector(parse_stretches("reordered=1@0+1"), Truth())
    frame = CanFrame(0x004, bytes(8))
    assert list(injector.disturb(0.0, frame)) == []
    freed = [sent.fate for sent in injector.disturb(1.0, frame)]
    assert freed == ["reordered", "intact"]


def test_two_faults_that_end_at_once_free_what_both_held():
    frames = [CanFrame(can_id, bytes(8)) for can_id, _ in USPA44_MAP.wire_order("4")[:15]]
    for seed in range(20):
        injector = Injector(parse_stretches("reordered=1@0+1,reordered=.5@0+1"), Truth(), seed)
        came = [sent.frame for n, frame in enumerate(frames) for sent in injector.disturb(n / 100, frame)]
        came += [sent.frame for sent in injector.advance(1.0)]
        assert sorted(came) == sorted(frames)


def test_a_flipped_digit_is_told_as_the_reader_reads_it():
    played = Played("flipped=.1@0+2")
    shown = {tuple(reading) for scan in played.scans for reading in scan.counts.reshape(3, 16).T.tolist()}
    flipped = played.told[played.told["fate"] == FATES.index("flipped")]
    assert len(flipped) > 100 and played.reader.counters()["bad_lines"] == 0
    for row in flipped:
        sensor, taxel = USPA44_MAP.taxels[int(row["can_id"])]
        track = BUS[("4", "6").index(sensor)].track
        assert row["xyz"].tolist() != track.counts[row["cycle"]].reshape(3, 16)[:, taxel].tolist()
        assert tuple(row["xyz"].tolist()) in shown


def test_what_finds_no_room_is_lost_and_the_rest_of_its_line_is_noise():
    truth, frame = Truth(), CanFrame(0x004, bytes(8))
    line = encode_frame(frame)
    sent = BusFrame(0.0, frame, 0)
    for written in (len(line), 5, 0, len(line)):
        truth.hand_on(Piece(line, sent), written, 0, 0)
    truth.settle(0)
    assert truth.fates == Counter(intact=2, overflow=2)
    assert truth.counters() == {"frames": 2, "foreign": 0, "bad_lines": 0, "skipped_bytes": 5, "duplicates": 1}


@pytest.mark.parametrize("unread", [0, 1, 21, 22, 23, 44])
def test_what_lies_unread_when_a_reader_leaves_was_never_read(unread):
    truth, reader = Truth(), SlcanScans()
    frames = [CanFrame(can_id, bytes(8)) for can_id in (0x004, 0x014)]
    truth.open_channel()
    for frame in frames:
        truth.hand_on(Piece(encode_frame(frame), BusFrame(0.0, frame, 0)), 22, 0, 0)
    reader.feed(b"".join(map(encode_frame, frames))[: 44 - unread], 0)
    truth.close_channel(unread)
    truth.open_channel()
    reader.begin_anew()
    counted = reader.counters()
    assert truth.counters() == {name: counted[name] for name in truth.counters()}
    assert truth.fates["unread"] == 2 - counted["frames"] == -(-unread // 22)


def test_what_the_kernel_may_not_have_counted_yet_is_not_taken_for_read():
    truth, frame = Truth(), CanFrame(0x004, bytes(8))
    for time_ns in (0, 5, 10):
        truth.hand_on(Piece(encode_frame(frame), BusFrame(0.0, frame, 0)), 22, time_ns, time_ns)
    truth.settle(22, counted_ns=5)  # one is counted; the last may be that one, or wait there after it
    assert truth.frames == 1
    truth.close_channel(44)
    assert truth.fates == Counter(intact=1, unread=2)


def test_what_a_client_left_is_counted_whenever_the_kernel_counts_it(monkeypatch):
    port, counts = PseudoPort(), iter([3, 20, 44, 44])
    monkeypatch.setattr(port, "unread_bytes", lambda: next(counts))
    assert port.left_bytes() == 44


def test_answers_are_no_bad_lines_unless_they_end_one():
    truth = Truth()
    truth.hand_on(Piece(b"V1013\r\r\a", None, answer=True), 8, 0, 0)
    truth.settle(0)
    assert truth.bad_lines == 0 and truth.noise == 0
    truth.hand_on(Piece(b"t00", None), 3, 0, 0)
    truth.hand_on(Piece(b"\r", None, answer=True), 1, 0, 0)
    truth.settle(0)
    assert (truth.bad_lines, truth.skipped_bytes, truth.noise) == (1, 3, 1)


# When.


def test_stretches_as_a_user_writes_them():
    assert parse_stretches("unplug@8+.5, lost=.05@2+3") == [
        Stretch("lost", ".05", 2.0, 5.0),
        Stretch("unplug", "", 8.0, 8.5),
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("loss@2+3", r"fault is 'loss', expected one of: lost, .*mixed"),
        ("lost", r"fault is 'lost', expected NAME@START\+LENGTH"),
        ("lost@-1+2", "expected NAME"),
        ("lost@1+nan", "expected NAME"),
        ("lost@1+", "expected NAME"),
    ],
)
def test_stretches_that_cannot_be(text, words):
    with pytest.raises(ValueError, match=words):
        parse_stretches(text)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("lost=2@0+1", "share is '2'"),
        ("flipped=x@0+1", "share is 'x'"),
        ("dead=4.16@0+1", r"taxel is '4\.16'"),
        ("silent=17@0+1", "sensor is '17'"),
        ("unplug=1@0+1", "unplug takes no parameter"),
    ],
)
def test_parameters_that_cannot_be_are_told_before_anything_runs(text, words):
    with pytest.raises(ValueError, match=words):
        Injector(parse_stretches(text), Truth())


def test_a_mixture_holds_everything_and_ends_in_calm():
    stretches = mixture(4.0, 60.0, seed=3)
    assert {stretch.name for stretch in stretches} == set(NAMES)
    assert stretches == mixture(4.0, 60.0, seed=3) != mixture(4.0, 60.0, seed=4)
    assert stretches[0].start_s >= 4.0 and max(stretch.end_s for stretch in stretches) <= 64.0 - CALM_S
    breaks = [stretch for stretch in stretches if stretch.name in LINK_FAULTS]
    assert all(later.start_s >= one.end_s + CALM_S / 2 for one, later in pairwise(breaks))
    assert max(sum(a.start_s <= b.start_s < a.end_s for a in stretches) for b in stretches) >= 3
    assert parse_stretches("mixed@4+60", seed=3) == stretches


def test_the_injector_says_when_the_link_is_out():
    told = []
    stretches = parse_stretches("unplug@1+1,rename@3+1,reset@5+1,bursts@6+1")
    injector = Injector(stretches, Truth(), tell=lambda what, stretch: told.append((what, stretch.name)))
    seen = []
    for tenth in range(80):
        injector.advance(tenth / 10)
        seen.append((injector.unplugged, injector.renamed, injector.resets))
    assert [n for n, (out, _, _) in enumerate(seen) if out] == [*range(10, 20), *range(30, 40)]
    assert [n for n, (_, elsewhere, _) in enumerate(seen) if elsewhere] == [*range(30, 40)]
    assert len(list(takewhile(lambda one: one[2] == 0, seen))) == 50 and seen[-1][2] == 1
    assert told == [(what, name) for name in ("unplug", "rename", "reset", "bursts") for what in ("begin", "end")]
    assert injector.latency_s(6.5, 0.001) == BURST_S and injector.latency_s(7.5, 0.001) == 0.001


def test_bursts_may_lie_within_one_another():
    injector = Injector(parse_stretches("bursts@6+3,bursts@7+.5,bursts@20+1"), Truth())
    held_s = [injector.latency_s(time_s, 0.001) for time_s in (5.9, 6.0, 7.2, 8.0, 9.0, 20.5, 21.0)]
    assert held_s == [0.001, BURST_S, BURST_S, BURST_S, 0.001, BURST_S, 0.001]


def test_chance_is_the_seeds_alone():
    assert Played("mixed@0+4,lost=.2@0+1", 1).bus == Played("mixed@0+4,lost=.2@0+1", 1).bus
    assert Played("lost=.2@0+1", 1).bus != Played("lost=.2@0+1", 2).bus
    assert set(READ) < set(FATES)
