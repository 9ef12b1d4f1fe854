"""Emulated controller and slcan adapter as of firmware_bridge.emulation.slcan_main, with faults between bus and client.

    python tests/system/fault_emulator.py FILE [FILE] --faults lost@2+3

The first line it prints is the port; with --buses the first lines are, one for each bus.
"""

import argparse
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from fault_injector import Injector
from fault_lines import Piece
from fault_log import TruthFiles
from fault_stretches import parse_stretches
from fault_truth import Truth

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.pty_port import COUNTED_LATE_NS
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.emulation.slcan_main import argument_parser, play
from firmware_bridge.recording.tracks import Recording

_LONGEST_DRAIN_S: Final = 0.5


class FaultyEmulator(Emulator):
    """Emulator with faults between bus and client, which also pull the cable and reset the adapter."""

    def __init__(self, recordings: Sequence[Recording], *, faults: Injector, **usual: Any) -> None:
        super().__init__(recordings, **usual)
        self._faults = faults
        self._truth = faults.truth
        self._resets = 0
        self._elsewhere = False

    def tell(self, line: bytes) -> None:
        self._send([Piece(line, None, answer=True)], time.monotonic_ns())

    def _unplug(self) -> None:
        self._truth.close_channel(self.line.unread_bytes())
        super()._unplug()

    def _latency_at(self, time_s: float) -> float:
        return self._faults.latency_s(time_s, self._latency_s)

    def _hand_on(self, frames: Iterable[tuple[float, CanFrame]]) -> Iterator[float]:
        faults, truth, pieces = self._faults, self._truth, list[Piece]()
        now_ns = time.monotonic_ns()
        for time_s, frame in frames:
            for sent in faults.disturb(time_s, frame):
                if sent.lost:
                    truth.lose(sent, now_ns)
                elif not (self.line.plugged and self.adapter.hears_the_bus):
                    truth.lose(sent._replace(fate="unheard"), now_ns)
                else:
                    pieces += faults.corrupt(self.adapter.encode(sent.frame, sent.time_s + self._still_s), sent)
        truth.settle(self.line.unread_bytes(), now_ns - COUNTED_LATE_NS)
        self._send(pieces, now_ns)
        if faults.resets > self._resets:
            self._resets = faults.resets
            self.adapter.begin_anew()
        if faults.unplugged and self.line.plugged:
            yield from self._drain(time.monotonic() + _LONGEST_DRAIN_S)
            truth.close_channel(self.line.unread_bytes())
            self.line.unplug()
            self._elsewhere = faults.renamed
        elif not faults.unplugged and not self.line.plugged:
            self.adapter.begin_anew()
            self.line.plug(elsewhere=self._elsewhere)

    def _send(self, pieces: Sequence[Piece], now_ns: int) -> None:
        """Write pieces, and report to the truth how much of each went out."""
        room = self.line.write(b"".join(piece.data for piece in pieces))
        written_ns = time.monotonic_ns()
        for piece in pieces:
            written = min(max(room, 0), len(piece.data))
            room -= len(piece.data)
            self._truth.hand_on(piece, written, now_ns, written_ns)
            self.sent_frames += room >= 0 and piece.sent is not None
            self.lost_frames += room < 0 and piece.sent is not None

    def obey(self, received: bytes) -> None:
        was_open = self.adapter.channel_open
        unread_bytes = self.line.left_bytes() if b"C" in received else self.line.unread_bytes()
        answer = self.adapter.feed(received)
        if self.adapter.channel_open != was_open:  # closing and opening drop old bytes, answers as well
            self._truth.close_channel(unread_bytes)
        if not self.adapter.channel_open:
            self.line.write(answer)
            return
        if not was_open:
            self._truth.open_channel()
        self._send([Piece(answer, None, answer=True)], time.monotonic_ns())


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argument_parser("python tests/system/fault_emulator.py", __doc__)
    parser.add_argument("--faults", default="", metavar="F", help="such as lost@2+3 or mixed@5+600; see docs/run.md")
    parser.add_argument("--truth", type=Path, metavar="DIR", help="what became of each frame")
    return play(parser, arguments, _emulator)


def _emulator(
    recordings: Sequence[Recording], usual: Mapping[str, Any], options: argparse.Namespace, closing: ExitStack
) -> FaultyEmulator:
    if options.truth and options.buses > 1:
        raise ValueError(f"--truth is of one bus, and --buses is {options.buses}: leave one out")
    truth = closing.enter_context(TruthFiles(options.truth)) if options.truth else None
    seed = usual["seed"]
    stretches = parse_stretches(options.faults, seed) if options.faults else []
    faults = truth.injector(stretches, seed) if truth else Injector(stretches, Truth(), seed)
    return FaultyEmulator(recordings, faults=faults, **usual)


if __name__ == "__main__":
    sys.exit(main())
