"""Injector of faults: frames from the bus in, pieces for the reader out."""

import random
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

from fault_frames import FRAME_FAULTS, BusFrame, FrameFault
from fault_frames import through as through_frame_faults
from fault_lines import LINE_FAULTS, LineFault, Piece
from fault_lines import through as through_line_faults
from fault_stretches import BURSTS, RENAME, RESET, UNPLUG, Stretch
from fault_truth import Truth

from firmware_bridge.can.slcan import CanFrame

BURST_S = 0.016


class _Active(NamedTuple):
    stretch: Stretch
    frame: FrameFault | None
    line: LineFault | None


class Injector:
    """Injector of the faults of its stretches into a stream, in time order.

    Attributes:
        stretches: the faults with their intervals.
        truth: the fates of all frames.
        begun: number of stretches that have begun, by fault.
        unplugged: True while the cable is out.
        renamed: True if it comes back under another name.
        resets: number of resets of the adapter.
    """

    def __init__(
        self,
        stretches: Sequence[Stretch],
        truth: Truth,
        seed: int = 0,
        *,
        tell: Callable[[str, Stretch], object] = lambda what, stretch: None,
    ) -> None:
        """Prepare for the first frame.

        Args:
            stretches: stretches of `parse_stretches`.
            truth: records the fates of the frames.
            seed: seed of all random numbers.
            tell: called with "begin" and "end" of each stretch.

        Raises:
            ValueError: a fault has a parameter that it does not take.
        """
        self.stretches = sorted(stretches, key=lambda stretch: stretch.start_s)
        self.truth = truth
        self.begun: Counter[str] = Counter()
        self.unplugged = False
        self.renamed = False
        self.resets = 0
        self._seed = seed
        self._tell = tell
        self._waiting = list(enumerate(self.stretches))
        self._active: list[_Active] = []
        self._sent: Counter[int] = Counter()
        # Asked for at every frame: an hour of a mixture has thousands of stretches.
        bursts = [one for one in self.stretches if one.name == BURSTS]
        self._burst_starts_s = [one.start_s for one in bursts]
        self._burst_ends_s = list(accumulate((one.end_s for one in bursts), max))
        for number, stretch in self._waiting:
            self._start(number, stretch)  # started once for its errors, before anything runs

    def latency_s(self, time_s: float, usual_s: float) -> float:
        """Return the time for which the adapter holds back a frame that was on the bus at `time_s`, in [s]."""
        begun = bisect_right(self._burst_starts_s, time_s)
        return max(BURST_S, usual_s) if begun and time_s < self._burst_ends_s[begun - 1] else usual_s

    def advance(self, time_s: float) -> list[BusFrame]:
        """Begin and end the faults that are due; return the frames that an ended fault had held back."""
        freed: list[BusFrame] = []
        due = [one for one in self._active if one.stretch.end_s <= time_s]
        for one in [one for one in due if one.frame is None or one.frame.winds_down()]:
            place = self._active.index(one)
            self._active.remove(one)
            self._tell("end", one.stretch)
            if one.frame is not None:
                later = [left.frame for left in self._active[place:] if left.frame is not None]
                freed += [out for held in one.frame.end() for out in through_frame_faults(later, held)]
        while self._waiting and self._waiting[0][1].start_s <= time_s:
            number, stretch = self._waiting.pop(0)
            self.begun[stretch.name] += 1
            self._tell("begin", stretch)
            self.resets += stretch.name == RESET
            if stretch.end_s > time_s:
                self._active.append(self._start(number, stretch))
            else:  # shorter than the time between two frames
                self._tell("end", stretch)
        names = {one.stretch.name for one in self._active}
        self.unplugged, self.renamed = bool(names & {UNPLUG, RENAME}), RENAME in names
        return freed

    def disturb(self, time_s: float, frame: CanFrame) -> Iterator[BusFrame]:
        """Yield the frames on the bus that replace a frame, lost ones included."""
        sent = BusFrame(time_s, frame, self._sent[frame.can_id])
        self._sent[frame.can_id] += 1
        yield from self.advance(time_s)
        yield from through_frame_faults([one.frame for one in self._active if one.frame is not None], sent)

    def corrupt(self, line: bytes, sent: BusFrame) -> Iterator[Piece]:
        """Yield the pieces that replace the line of a frame that is not lost."""
        faults = [one.line for one in self._active if one.line is not None]
        yield from through_line_faults(faults, Piece(line, sent))

    def _start(self, number: int, stretch: Stretch) -> _Active:
        draw = random.Random(f"{self._seed} {number} {stretch.name}")
        frame, line = FRAME_FAULTS.get(stretch.name), LINE_FAULTS.get(stretch.name)
        if frame is None and line is None and stretch.parameter:
            raise ValueError(f"{stretch.name} takes no parameter, but has {stretch.parameter!r}")
        return _Active(
            stretch,
            None if frame is None else frame(draw, stretch.parameter),
            None if line is None else line(draw, stretch.parameter),
        )
