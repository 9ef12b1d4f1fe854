"""Buses with faults between emulated sensors and whoever reads their adapters, over pseudo-terminals.

    python tests/system/chaos_wire.py press.mcap --link /tmp/skin --faults unplug@5+1,lost=0.05@8+2,mixed@12+60

plays recordings over and over, with faults at their times since the channel was first opened:

    lost@2+3               from the second second on, for three seconds
    lost=0.05@2+3          one frame in twenty
    mixed@5+600            all faults, drawn from the seed, for ten minutes

No fault makes a frame that is well formed and was never sent, since the wire has no checksum: noise ends no line but
its own, and a line is cut from its end and never down to a whole frame.
"""

import argparse
import math
import random
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import chain, count, groupby
from pathlib import Path
from typing import Final, NamedTuple

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.pty_port import EmulatorThread, PseudoPort
from firmware_bridge.emulation.slcan_emulator import SlcanAdapter, bus_timeline, controllers_of
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.can_id_maps import USPA44_MAP

MIXED: Final = "mixed"
CALM_S: Final = 3.0
"""Time without faults at the end of a mixture, and between two breaks of the link."""
LONGEST_S: Final = 1.5
LATENCY_S: Final = 0.001
BURST_S: Final = 0.016
"""Time for which an adapter with FTDI's default holds bytes back."""
STOOD_STILL_S: Final = 0.2
"""Lateness at which the emulator itself was stopped: it goes on where it was, as no controller catches up."""
DRAIN_S: Final = 0.5
_NOISE: Final = bytes(value for value in range(256) if value not in b"\r\a")


class Sent(NamedTuple):
    """Frame on the bus: its time in [s] since the first, and the number of its sensor's cycle."""

    time_s: float
    frame: CanFrame
    cycle: int

    @property
    def sensor(self) -> str:
        """Return the sensor's name, empty for a foreign frame."""
        return USPA44_MAP.taxels.get(self.frame.can_id, ("", 0))[0]


BusFault = Callable[[list[Sent]], list[Sent]]
LineFault = Callable[[bytes], bytes]


def _struck(strike: Callable[[random.Random, Sent], list[Sent]]) -> Callable[..., BusFault]:
    """Return a fault that replaces a share of the frames."""
    return lambda draw, share: (
        lambda batch: [new for one in batch for new in (strike(draw, one) if draw.random() < share else [one])]
    )


def _foreign(draw: random.Random, sent: Sent) -> list[Sent]:
    return [Sent(sent.time_s, CanFrame(0x740 | draw.randrange(16), draw.randbytes(8)), -1), sent]


def _swapping(draw: random.Random, share: float) -> BusFault:
    def swap(batch: list[Sent]) -> list[Sent]:
        for at in range(0, len(batch) - 1, 2):
            if draw.random() < share:
                batch[at : at + 2] = batch[at + 1], batch[at]
        return batch

    return swap


def _without(same: Callable[[Sent], object]) -> Callable[..., BusFault]:
    """Return a fault that loses all frames that are alike in this to one that is drawn."""

    def begin(draw: random.Random, share: float) -> BusFault:
        drawn: list[object] = []

        def lose(batch: list[Sent]) -> list[Sent]:
            if batch and not drawn and draw.random() < share:
                drawn.append(same(draw.choice(batch)))
            return [one for one in batch if same(one) not in drawn]

        return lose

    return begin


def _gaps(draw: random.Random, share: float) -> BusFault:
    """Return a fault that loses as many frames in a row as make the parts of two cycles fit."""
    left = 0

    def kept(_: Sent) -> bool:
        nonlocal left
        left = left - 1 if left else 16 * draw.randint(1, 6) if draw.random() < share else 0
        return not left

    return lambda batch: list(filter(kept, batch))


def _vanishing(draw: random.Random, share: float) -> BusFault:
    key = draw.random()
    return lambda batch: [one for one in batch if random.Random(f"{key} {one.sensor} {one.cycle}").random() >= share]


def _line(spoil: Callable[[random.Random, bytes], bytes]) -> Callable[..., LineFault]:
    return lambda draw, share: lambda line: spoil(draw, line) if draw.random() < share else line


def _high_bit(draw: random.Random, line: bytes) -> bytes:
    at = draw.randrange(len(line) - 1)
    return line[:at] + bytes([line[at] | 0x80]) + line[at + 1 :]


BUS_FAULTS: Final[dict[str, Callable[..., BusFault]]] = {
    "lost": _struck(lambda draw, sent: []),
    "gaps": _gaps,
    "repeated": _struck(lambda draw, sent: [sent, sent]),
    "foreign": _struck(_foreign),
    "reordered": _swapping,
    "dead": _without(lambda sent: sent.frame.can_id),
    "silent": _without(lambda sent: sent.sensor),
    "vanished": _vanishing,
    "bus-off": _struck(lambda draw, sent: []),
}
USUAL_SHARE: Final = {"gaps": 0.01, "dead": 0.25, "silent": 0.25, "vanished": 0.05, "bus-off": 1.0}
"""Share of frames, of cycles, or of looks for a victim, that a fault strikes by default; 0.02 where none is given."""
LINE_FAULTS: Final[dict[str, Callable[..., LineFault]]] = {
    "garbage": _line(lambda draw, line: bytes(draw.choices(_NOISE, k=draw.randint(12, 200))) + b"\r" + line),
    "truncated": _line(lambda draw, line: line[: draw.randint(1, 20)] + b"\r"),
    "merged": _line(lambda draw, line: line[: draw.randint(1, len(line) - 1)]),
    "non-ascii": _line(_high_bit),
}
BURSTS, UNPLUG, RENAME, RESET = "bursts", "unplug", "rename", "reset"
LINK_FAULTS: Final = (UNPLUG, RENAME, RESET)
NAMES: Final = (*BUS_FAULTS, *LINE_FAULTS, BURSTS, *LINK_FAULTS)


_NUMBER: Final = r"\d*\.?\d+"
_FAULT: Final = re.compile(rf"(?P<name>[a-z-]+)(=(?P<share>{_NUMBER}))?@(?P<start>{_NUMBER})\+(?P<length>{_NUMBER})")


class Stretch(NamedTuple):
    """Fault, the share that it strikes, and its interval in [s]."""

    name: str
    share: float
    start_s: float
    end_s: float


def stretches(text: str, seed: int) -> list[Stretch]:
    """Parse faults as a user writes them; raises ValueError where there is no such fault, share or time."""
    found: list[Stretch] = []
    for part in filter(None, text.split(",")):
        read = _FAULT.fullmatch(part)
        if read is None or read["name"] not in (*NAMES, MIXED):
            names = ", ".join((*NAMES, MIXED))
            raise ValueError(f"fault is {part!r}, expected NAME[=SHARE]@START+LENGTH in seconds, NAME one of: {names}")
        name, start_s, long_s = read["name"], float(read["start"]), float(read["length"])
        share = float(read["share"] or USUAL_SHARE.get(name, 0.02))
        found += _mixture(start_s, long_s, seed) if name == MIXED else [Stretch(name, share, start_s, start_s + long_s)]
    return sorted(found, key=lambda one: one.start_s)


def _mixture(start_s: float, long_s: float, seed: int) -> Iterator[Stretch]:
    """Draw all faults in turns, several at once; breaks of the link well apart."""
    draw = random.Random(f"mixture {seed}")
    for names, pause_s in (((*BUS_FAULTS, *LINE_FAULTS, BURSTS), 0.4), (LINK_FAULTS, CALM_S)):
        time_s = start_s + draw.uniform(0, pause_s)
        for name in chain.from_iterable(draw.sample(names, len(names)) for _ in count()):
            fault_s = draw.uniform(0.2, LONGEST_S)
            if time_s + fault_s > start_s + long_s - CALM_S:
                break
            yield Stretch(name, USUAL_SHARE.get(name, 0.02), time_s, time_s + fault_s)
            time_s += draw.uniform(0.5, 1.5) * pause_s + fault_s * (name in LINK_FAULTS)


class FaultyBus:
    """Adapter on a bus with faults, played by an `EmulatorThread` from the first opening of its channel."""

    def __init__(
        self,
        timeline: Iterable[Sent],
        faults: Sequence[Stretch],
        seed: int,
        link: Path | None = None,
        on_sent: Callable[[Sent, int], object] = lambda sent, now_ns: None,
    ) -> None:
        """Prepare to play; `on_sent` gets each frame whose line goes out whole, just before it does, with the time."""
        self.line = PseudoPort(link)
        self.begun = Counter[str]()  # stretches, by fault
        self.handed = self.foreign = 0  # frames whose whole line was written, and those of them of another device
        self.unread_bytes = 0  # that a client which closed, or whose cable was pulled, had not fetched
        self.openings = 0  # of the channel
        self.back_ns: list[int] = []  # times at which the adapter could be used again
        self.over = False  # the whole timeline was played
        self._timeline, self._on_sent = timeline, on_sent
        self._adapter = SlcanAdapter()
        self._waiting = [(one, random.Random(f"{seed} {number}")) for number, one in enumerate(faults)]
        self._active: list[tuple[Stretch, BusFault | None, LineFault | None]] = []
        self._bursts = [one for one in faults if one.name == BURSTS]
        self._renamed, self._still_s = False, 0.0

    def plug(self) -> None:
        """Put the cable in."""
        self.line.plug()

    def course(self) -> Generator[float, None, None]:
        """Play; yield the monotonic time, in [s], at which to go on, or earlier when the client has written."""
        try:
            while not self._adapter.channel_open:
                yield math.inf
            start_s, cycle = time.monotonic(), -1
            for due_s, group in groupby(self._timeline, key=self._due_s):
                batch = list(group)
                due_s += start_s + self._still_s
                yield due_s
                while time.monotonic() < due_s:
                    yield due_s
                late_s = time.monotonic() - due_s
                if late_s > STOOD_STILL_S and batch[0].cycle != cycle:
                    self._still_s += late_s
                cycle = batch[-1].cycle
                self._advance(batch[0].time_s)
                yield from self._break_link()
                self._hand_on(batch)
            self.over = True
            while True:  # the sensors are switched off, and the adapter stays
                yield math.inf
        finally:
            self.line.unplug()

    def obey(self, received: bytes) -> None:
        """Answer what the client has written."""
        was_open = self._adapter.channel_open
        if was_open and b"C\r" in received:
            counted = 0
            for _ in range(4):  # a busy kernel counts sent bytes as unread up to 10 ms late
                counted = max(counted, self.line.unread_bytes())
                time.sleep(0.0025)
            self.unread_bytes += counted
        self.line.write(self._adapter.feed(received))
        self.openings += self._adapter.channel_open and not was_open

    def _due_s(self, sent: Sent) -> float:
        held = any(one.start_s <= sent.time_s < one.end_s for one in self._bursts)
        step_s = BURST_S if held else LATENCY_S
        return math.ceil(sent.time_s / step_s) * step_s

    def _advance(self, time_s: float) -> None:
        self._active = [one for one in self._active if one[0].end_s > time_s]
        while self._waiting and self._waiting[0][0].start_s <= time_s:
            stretch, draw = self._waiting.pop(0)
            self.begun[stretch.name] += 1
            bus, line = BUS_FAULTS.get(stretch.name), LINE_FAULTS.get(stretch.name)
            self._active.append((stretch, bus and bus(draw, stretch.share), line and line(draw, stretch.share)))
            if stretch.name == RESET:
                self._adapter.begin_anew()
                self.back_ns.append(time.monotonic_ns())

    def _break_link(self) -> Iterator[float]:
        names = {stretch.name for stretch, *_ in self._active}
        if names & {UNPLUG, RENAME}:
            self._renamed = RENAME in names
            until_s = time.monotonic() + DRAIN_S
            while self.line.plugged and self.line.unread_bytes() and time.monotonic() < until_s:
                yield time.monotonic() + LATENCY_S
            self.unread_bytes += self.line.unread_bytes()
            self.line.unplug()
        elif not self.line.plugged:
            self._adapter.begin_anew()
            self.line.plug(elsewhere=self._renamed)
            self.back_ns.append(time.monotonic_ns())

    def _hand_on(self, batch: list[Sent]) -> None:
        for _, bus, _ in self._active:
            batch = bus(batch) if bus else batch
        if not self._adapter.hears_the_bus or not self.line.plugged:
            return
        now_ns = time.monotonic_ns()
        pieces: list[tuple[bytes, Sent, bool]] = []
        for sent in batch:
            line = whole = self._adapter.encode(sent.frame, sent.time_s + self._still_s)
            for _, _, spoil in self._active:
                line = spoil(line) if spoil and line.endswith(whole) else line
            pieces.append((line, sent, line.endswith(whole)))
            if line.endswith(whole):
                self._on_sent(sent, now_ns)
        room = self.line.write(b"".join(line for line, *_ in pieces))
        for line, sent, whole in pieces:
            room -= len(line)
            self.handed += whole and room >= 0
            self.foreign += whole and room >= 0 and sent.cycle < 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Play recordings among faults until Ctrl-C."""
    parser = argparse.ArgumentParser(description="Play recordings over a wire with faults; prints the port.")
    parser.add_argument("file", nargs="+", help="recording, a sensor each")
    parser.add_argument("--faults", default="", metavar="F", help="such as lost@2+3 or mixed@5+600")
    parser.add_argument("--link", type=Path, metavar="PATH", help="symbolic link to the port")
    parser.add_argument("--rate-hz", type=float, help="scans a second of each sensor (default: as recorded)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    try:
        played = controllers_of([load_recording(path) for path in options.file], options.rate_hz)
        faults = stretches(options.faults, options.seed)
    except ValueError as error:
        parser.error(str(error))
    frames = bus_timeline(played, loop=True)
    bus = FaultyBus(numbered(frames), faults, options.seed, options.link)
    try:
        with EmulatorThread([bus]):
            print(bus.line.path, flush=True)
            while True:
                time.sleep(1.0)
    except KeyboardInterrupt:
        return 130


def numbered(frames: Iterable[tuple[float, CanFrame]]) -> Iterator[Sent]:
    """Yield frames with the numbers of their cycles."""
    sent = Counter[int]()
    for time_s, frame in frames:
        yield Sent(time_s, frame, sent[frame.can_id])
        sent[frame.can_id] += 1


if __name__ == "__main__":
    sys.exit(main())
