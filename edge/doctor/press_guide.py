"""Guided press: takes readings, and gives the next request or the answer; and the line that shows what is felt.

Written as a dialogue: each step makes a request, then waits for readings that fulfil it. Time is that of the scans.
"""

import os
import select
import sys
import time
from collections.abc import Callable, Generator, Sequence
from typing import Final, NamedTuple, TextIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from edge.doctor.pad_orientation import CORNERS, Answer, Press, corner_taxel
from edge.perception.contact_options import OFF_COUNTS, ON_COUNTS
from edge.terminal.text_wrap import columns, drawn, rewritable
from firmware_bridge.pad_geometry import USPA44, SensorGeometry

HOLD_SCANS: Final = 20
FREE_SCANS: Final = 20
PUSH_SCANS: Final = 10
PUSH_COUNTS: Final = 300.0
"""Least change of the summed x and y, about .2 N; noise of two counts a taxel sums up to eight."""
PATIENCE_S: Final = 60.0
TRIES: Final = 3
STEADY_SCANS: Final = 50
STEADY_COUNTS: Final = 30.0
STEADY_SHARE: Final = 0.02
LEAST_WEIGHT_COUNTS: Final = 100.0
GRAVITY_M_S2: Final = 9.80665


class Reading(NamedTuple):
    """Readings over the baseline (3, rows, cols) in counts, and their time, in [s]."""

    zeroed: NDArray[np.float32]
    time_s: float

    @property
    def load_counts(self) -> float:
        """Sum of the sizes of z, in either direction."""
        return float(np.abs(self.zeroed[2]).sum())

    @property
    def shear_counts(self) -> NDArray[np.float32]:
        """Sums of x and of y."""
        return self.zeroed[:2].sum(axis=(1, 2))


class _SkippedError(Exception):
    """Raised in a dialogue where the person skips the request."""


T = TypeVar("T")
Dialogue = Generator[str | None, Reading, T]


class GuidedPress:
    """Dialogue that asks a person for four presses on corners, one after the other, then for a weight.

    Attributes:
        first: the first request.
        done: True when there are no more requests.
        answer: results so far; complete when `done`.
    """

    def __init__(self, weight_g: float | None = None, geometry: SensorGeometry = USPA44) -> None:
        """Prepare to ask; a weight is asked for where `weight_g` holds its mass in [g]."""
        self.done = False
        self.answer = Answer()
        self._held: NDArray[np.float32] = np.zeros(geometry.scan_shape, dtype=np.float32)
        self._dialogue = self._all(geometry.corners, weight_g)
        self.first: Final = next(self._dialogue) or ""

    def push(self, zeroed: NDArray[np.float32], time_s: float) -> str | None:
        """Take one more reading; returns the next request, or None.

        Args:
            zeroed: (3, rows, cols), over the baseline, in counts; where it is NaN the taxel's last reading stands.
            time_s: of its scan, in [s].
        """
        self._held = np.where(np.isnan(zeroed), self._held, zeroed)
        return self._go_on(lambda: self._dialogue.send(Reading(self._held, time_s)))

    def skip(self) -> str | None:
        """Leave the open request out; returns the next one, or None."""
        return self._go_on(lambda: self._dialogue.throw(_SkippedError()))

    @property
    def felt(self) -> float:
        """Load on the pad by the last reading, of that at which a press is measured."""
        return float(np.abs(self._held[2]).sum()) / ON_COUNTS

    def _go_on(self, step: Callable[[], str | None]) -> str | None:
        if self.done:
            return None
        try:
            return step()
        except (StopIteration, _SkippedError):  # a dialogue without another way ends where it is skipped
            self.done = True
            return None

    def _all(self, corners: Sequence[int], weight_g: float | None) -> Dialogue[None]:
        for place, name in zip(corners, CORNERS, strict=True):
            try:
                press = yield from _corner(place, name)
            except _SkippedError:
                # A finger that is still there would be taken for one on the next corner.
                if (yield from _wait("Skipped. Let go.", _free, FREE_SCANS)) is None:
                    break
                continue
            if press is None:  # nobody is there, or nothing is felt: three corners are enough, and fewer settle nothing
                break
            self.answer.presses.append(press)
        if weight_g is not None:
            self.answer.counts_per_newton = yield from _weigh(weight_g)


def _corner(place: int, name: str) -> Dialogue[Press | None]:
    ask = f"Press the {name} corner with a finger, about as hard as a stiff doorbell, and hold it."
    for _ in range(TRIES):
        held = yield from _wait(ask, _touched, HOLD_SCANS)
        if held is None:
            return None
        mean = np.mean([reading.zeroed for reading in held], axis=0)
        taxel = corner_taxel(mean[2])
        if taxel is not None:
            break
        yield from _wait("That was not a corner. Let go.", _free, FREE_SCANS)
        ask = f"Press the {name} corner itself and hold it."
    else:
        return None
    before = mean[:2].sum(axis=(1, 2))

    def pushed(reading: Reading) -> bool:
        return _touched(reading) and bool(np.abs(reading.shear_counts - before).min() >= PUSH_COUNTS)

    felt = yield from _wait(
        "Still pressing, push towards the middle of the pad.", lambda one: pushed(one) or _free(one), PUSH_SCANS
    )
    push = None
    if felt is not None and pushed(felt[-1]):
        x, y = np.mean([reading.shear_counts for reading in felt], axis=0) - before
        push = (float(x), float(y))
    yield from _wait("Good. Let go." if push else "No push was measured. Let go.", _free, FREE_SCANS)
    return Press(place, taxel, float(mean[2].sum()), push)


def _weigh(weight_g: float) -> Dialogue[float | None]:
    """Return counts of the summed z per [N]; None where nothing steady was laid on."""
    steady: list[float] = []

    def lies_still(reading: Reading) -> bool:
        steady.append(float(reading.zeroed[2].sum()))
        del steady[:-STEADY_SCANS]
        low, high = min(np.abs(steady)), max(np.abs(steady))
        still = high - low < max(STEADY_COUNTS, STEADY_SHARE * high)
        return len(steady) == STEADY_SCANS and low > LEAST_WEIGHT_COUNTS and still

    laid = yield from _wait(f"Lay {weight_g:g} g on the middle of the pad, hands off.", lies_still, 1)
    if laid is None:
        return None
    counts = abs(float(np.mean(steady)))
    yield from _wait("Good. Take it off.", _free, FREE_SCANS)
    return counts / (weight_g / 1000 * GRAVITY_M_S2)


def _wait(say: str, fulfils: Callable[[Reading], bool], scans: int) -> Dialogue[list[Reading] | None]:
    """Make a request, and return as many readings in a row that fulfil it, or None when patience is at its end."""
    reading = yield say
    end_s = reading.time_s + PATIENCE_S
    held: list[Reading] = []
    while True:
        held = [*held, reading] if fulfils(reading) else []
        if len(held) >= scans:
            return held
        if reading.time_s > end_s:
            return None
        reading = yield None


def _touched(reading: Reading) -> bool:
    return reading.load_counts >= ON_COUNTS


def _free(reading: Reading) -> bool:
    return reading.load_counts < OFF_COUNTS


REFRESH_S: Final = 0.1
BAR: Final = 10


class FeltLine:
    """Line that is rewritten in place on a terminal; nothing is written elsewhere."""

    def __init__(self, stream: TextIO, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._stream = drawn(stream)
        self._clock_s = clock_s
        self._shown = 0
        self._shown_s = self._asked_s = clock_s()

    def asked(self) -> None:
        """Begin the time of a request."""
        self._asked_s = self._clock_s()

    def show(self, guide: GuidedPress) -> None:
        """Show the load on the pad, at most ten times a second."""
        now_s = self._clock_s()
        if now_s - self._shown_s < REFRESH_S or not rewritable(self._stream):
            return
        self._shown_s = now_s
        full = min(int(BAR * guide.felt), BAR)
        left_s = max(PATIENCE_S - (now_s - self._asked_s), 0)
        skip = ", Enter skips" if _stdin_is_terminal() else ""
        self._write(f"felt [{'#' * full:{BAR}}] {left_s:.0f} s left{skip}")

    def clear(self) -> None:
        """Clear the line, for text that stays."""
        if self._shown:
            self._write("")
            self._stream.write("\r")

    def _write(self, text: str) -> None:
        text = text[: columns() - 1]
        self._stream.write("\r" + text.ljust(self._shown))
        self._stream.flush()
        self._shown = len(text)


def enter_pressed() -> bool:
    """Return whether Enter was pressed on the terminal since the last call; never waits."""
    if not _stdin_is_terminal() or not select.select([sys.stdin.fileno()], [], [], 0)[0]:
        return False
    return b"\n" in os.read(sys.stdin.fileno(), 1024)


def _stdin_is_terminal() -> bool:
    # Only on POSIX can a terminal be polled for input.
    return os.name == "posix" and sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()
