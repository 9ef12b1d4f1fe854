"""Guided press: the dialogue that asks for presses on four corners, and the mounting of the pad that they show.

Corners are those that a person sees; seen from above, as patterns are drawn, x points right and y down. Pushed towards
the middle of the pad, its surface moves along both axes, and each corner has another pair of signs: so each of the two
readings fits only one axis and one direction, and any three corners settle which.
"""

from collections.abc import Callable, Collection, Generator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from edge.doctor.findings import Finding, judged
from edge.perception.run_options import OFF_COUNTS, ON_COUNTS
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.scans.mounting import Mounting

AS_MAPPED: Final = "as in the id map"  # name of the orientation in which nothing is to be corrected
CORNERS: Final = ("top left", "top right", "bottom right", "bottom left")
FEWEST_CORNERS: Final = 3


@dataclass(frozen=True)
class Press:
    """Press on one corner."""

    place: int  # corner of the geometry that was asked for
    taxel: int  # corner that answered
    z_counts: float  # summed over the pad
    push_counts: tuple[float, float] | None  # change of summed x and y when pushed to the middle; None if not felt


def orders(geometry: SensorGeometry = USPA44) -> dict[str, tuple[int, ...]]:
    """Return the eight orientations in which a pad can lie, four if not square, by name: the taxel of every place."""
    grid = np.arange(geometry.taxel_count).reshape(geometry.rows, geometry.cols)
    orientations: dict[str, tuple[int, ...]] = {}
    for mirrored in (False, True):
        for quarters in range(4) if geometry.rows == geometry.cols else (0, 2):
            turn = f"turned by {90 * quarters} degrees clockwise" if quarters else ""
            ways = ("mirrored left to right" if mirrored else "", turn)
            turned = np.rot90(np.fliplr(grid) if mirrored else grid, -quarters)
            orientations[", then ".join(filter(None, ways)) or AS_MAPPED] = tuple(turned.ravel().tolist())
    return orientations


def corner_taxel(z_counts: NDArray[np.floating]) -> int | None:
    """Return the corner of the taxels that z (rows, cols) lies on; None where it lies on no corner."""
    sizes = np.abs(z_counts)
    weights = np.clip(sizes - 0.2 * sizes.max(), 0, None)
    if not weights.sum() > 0:
        return None
    down, right = (
        float((weights * at).sum() / weights.sum()) - (size - 1) / 2
        for at, size in zip(np.indices(weights.shape), weights.shape, strict=True)
    )
    if min(abs(down), abs(right)) < 0.4:  # pitches from a midline
        return None
    rows, cols = weights.shape
    return (0 if down < 0 else (rows - 1) * cols) + (0 if right < 0 else cols - 1)


def find_order(presses: Sequence[Press], geometry: SensorGeometry = USPA44) -> str | None:
    """Return the name of the pad's orientation in `orders`; None where no orientation fits."""
    for name, order in orders(geometry).items():
        if all(order[press.place] == press.taxel for press in presses):
            return name
    return None


def find_axes(presses: Sequence[Press], geometry: SensorGeometry = USPA44) -> tuple[bool, tuple[int, int]] | None:
    """Return whether x and y are swapped, and their signs after that; None where pushes are too few or contradict."""
    pushes = [press for press in presses if press.push_counts is not None]
    if len(pushes) < FEWEST_CORNERS:
        return None
    felt = np.array([press.push_counts for press in pushes])
    to_the_middle = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])  # signs of x and y of a push from each corner
    expected = np.array([to_the_middle[geometry.corners.index(press.place)] for press in pushes])
    # Each corner has one vote, so that a strong push at one corner does not outvote the others.
    votes = np.sign(felt).T @ expected / len(pushes)  # rows: the wire's x and y; columns: the pad's
    for swap in (False, True):
        along = votes[[1, 0]] if swap else votes
        # 1 where every corner agrees, 0.5 or 0 where one of four or three contradicts, 0 for the other axis.
        if (np.abs(np.diag(along)) >= 0.8).all():
            return swap, (int(np.sign(along[0, 0])), int(np.sign(along[1, 1])))
    return None


_AGAIN: Final = "press again: run the doctor once more"
_NORM: Final = "as the model expects: x right, y down, z up when pressed"


def judge_press(
    presses: Sequence[Press], geometry: SensorGeometry = USPA44, *, kept: bool = False
) -> tuple[list[Finding], Mounting | None]:
    """Return the findings, and the mounting that they give, None while unclear. What a file has `kept` is right."""
    if len(presses) < FEWEST_CORNERS:
        measured = f"{len(presses)} of 4 corners measured"
        return [Finding(name, "not known", measured, "", _AGAIN) for name in ("taxel order", "axis signs")], None
    verdict, remedy = "wrong", "write a sensor file, edge-sr doctor --out FILE, and run edge-sr --sensor FILE"
    if kept:
        verdict, remedy = "look", "the sensor file states this: run edge-sr with it"
    turn, axes = find_order(presses, geometry), find_axes(presses, geometry)
    z_signs = {int(np.sign(press.z_counts)) for press in presses}
    norm = "each corner answers where it is pressed"
    if turn is None:
        corners = ", ".join(f"{CORNERS[geometry.corners.index(press.place)]}: taxel {press.taxel}" for press in presses)
        other = "no turn of this pad has its corners so: run the doctor once more, or try another --id-map"
        order = Finding("taxel order", "wrong", corners, norm, other)
    else:
        order = judged("taxel order", "ok" if turn == AS_MAPPED else verdict, turn, norm, remedy)
    if axes is None or len(z_signs) > 1:
        return [order, _unclear_axes(sum(press.push_counts is not None for press in presses), z_signs)], None
    swapped, signs_xy = axes
    mounting = Mounting(swap_xy=swapped, signs=(*signs_xy, z_signs.pop()), taxel_count=geometry.taxel_count)
    ways = [way for way, sign in zip("xyz", mounting.signs, strict=True) if sign < 0]
    parts = ["x and y swapped"] * mounting.swap_xy + [f"{', '.join(ways)} reversed"] * bool(ways)
    measured = " and ".join(parts) or "x right, y down, z up when pressed"
    signs = judged("axis signs", verdict if parts else "ok", measured, _NORM, remedy)
    return [order, signs], None if turn is None else replace(mounting, order=orders(geometry)[turn])


def _unclear_axes(pushes: int, z_signs: Collection[int]) -> Finding:
    if len(z_signs) > 1:
        remedy = "z must do the same under every press: the pad was still loaded, or a taxel is reversed; press again"
        return Finding("axis signs", "wrong", "z rises under some presses and falls under others", _NORM, remedy)
    if pushes < FEWEST_CORNERS:
        remedy = f"push harder towards the middle while pressing; {_AGAIN}"
        return Finding("axis signs", "not known", f"{pushes} of 4 pushes measured", _NORM, remedy)
    remedy = f"push along the diagonal, towards the middle; {_AGAIN}"
    return Finding("axis signs", "wrong", "the corners contradict each other", _NORM, remedy)


class Weighed(NamedTuple):
    """Counts per newton of a pad, and half of their 90 % interval as a share of them."""

    counts_per_newton: float
    error: float

    @property
    def interval(self) -> tuple[float, float]:
        """Its 90 % interval."""
        return self.counts_per_newton * (1 - self.error), self.counts_per_newton * (1 + self.error)

    @property
    def plausible(self) -> bool:
        """Whether the interval holds a value that sensors have; else the weight has other grams than were typed."""
        low, high = self.interval
        return low <= PLAUSIBLE[1] and high >= PLAUSIBLE[0]


PLAUSIBLE: Final = (900.0, 1700.0)  # counts per newton, around the 1150 to 1370 of data sheets and of a fit

ASK_WEIGHT: Final = (
    "For forces in newtons, weigh something flat that covers the whole pad. Type its grams and Enter; Enter alone "
    "leaves it out."
)
LIGHTEST_G: Final = 20  # 0.2 N, three times what counts as a contact
HEAVIEST_G: Final = 4000  # 40 N, the deepest presses of the training
LEAST_SHARE: Final = 0.25  # of the mean, on the taxel that reads least under a weight that covers the pad
COVERED_ERROR: Final = 0.08
PARTLY_ERROR: Final = 0.3
"""By simulated discs of 2 N on 8 pads, in the middle and 1.5 mm off: those of 22 and 28 mm read 0.93 to 1.04 of the
right counts, those of 19 mm that pass as covering up to 1.09, and of 14 and 16 mm, which do not, 0.68 to 1.15."""


def judge_force(weighed: Weighed | None, *, kept: bool) -> Finding:
    """Return the finding on a weight that was laid on; None stands for nothing steady."""
    low, high = PLAUSIBLE
    norm = f"{low:.0f} to {high:.0f}"
    if weighed is None:
        return Finding("force", "not known", "no steady weight measured", norm, "lay it on the whole pad, hands off")
    counts_per_newton, error = weighed
    measured = f"{counts_per_newton:.0f} counts per newton, within {100 * error:.0f} %"
    if not weighed.plausible:
        remedy = (
            "no sensor reads so, and it is not kept: does the weight have the grams typed, and rest on the pad alone?"
        )
    elif error > COVERED_ERROR:
        remedy = "it bears on a part of the pad: lay it on something flat that covers all of it, and weigh both"
    elif not low <= counts_per_newton <= high:
        remedy = "is the weight as heavy as was typed, and does it lie on the pad alone?"
    else:
        use = "" if kept else f"edge-sr --counts-per-newton {counts_per_newton:.0f}"
        return Finding("force", "ok", measured, norm, use)
    return Finding("force", "look", measured, norm, remedy)


FREE_SCANS: Final = 20
PATIENCE_S: Final = 60.0
STEADY_SCANS: Final = 50


class Reading(NamedTuple):
    """Readings over the baseline (3, rows, cols) in counts, and their time, in [s]."""

    zeroed: NDArray[np.float32]
    time_s: float


class _TypedError(Exception):
    """Raised in a dialogue with the line that the person types; it leaves a request out that asks for no line."""


T = TypeVar("T")
Dialogue = Generator[str | None, Reading, T]


class GuidedPress:
    """Dialogue that asks a person for four presses on corners, one after the other, then to lay a weight on the pad."""

    def __init__(self, geometry: SensorGeometry = USPA44, *, weigh: bool = False) -> None:
        """Prepare to ask, with `weigh` for a weight, too."""
        self.done = False  # there are no more requests
        self.presses: list[Press] = []  # those that were felt
        self.weight_g: float | None = None  # mass of the weight; None where there is none
        self.weighed: Weighed | None = None  # by the weight, if one was laid on
        self._held: NDArray[np.float32] = np.zeros(geometry.scan_shape, dtype=np.float32)
        self._dialogue = self._all(geometry.corners, weigh)
        self.first: Final = next(self._dialogue) or ""

    def push(self, zeroed: NDArray[np.float32], time_s: float) -> str | None:
        """Take one more reading (3, rows, cols) over the baseline, in counts; returns the next request, or None."""
        self._held = np.where(np.isnan(zeroed), self._held, zeroed)  # of a torn scan the taxel's last reading stands
        return self._go_on(lambda: self._dialogue.send(Reading(self._held, time_s)))

    def type(self, line: str = "") -> str | None:
        """Take a line: an answer, or Enter alone, which leaves the open request out; returns the next one, or None."""
        return self._go_on(lambda: self._dialogue.throw(_TypedError(line)))

    def _go_on(self, step: Callable[[], str | None]) -> str | None:
        if self.done:
            return None
        try:
            return step()
        except (StopIteration, _TypedError):  # a dialogue without another way ends where it is skipped
            self.done = True
            return None

    def _all(self, corners: Sequence[int], weigh: bool) -> Dialogue[None]:
        for place, name in zip(corners, CORNERS, strict=True):
            try:
                press = yield from _corner(place, name)
            except _TypedError:
                # A finger that is still there would be taken for one on the next corner.
                if (yield from _wait("Skipped. Let go.", _free, FREE_SCANS)) is None:
                    return
                continue
            if press is None:  # nobody is there, or nothing is felt: three corners are enough, and fewer settle nothing
                return
            self.presses.append(press)
        if weigh:
            self.weight_g = yield from _mass_g()
        if self.weight_g is not None:
            self.weighed = yield from _weigh(self.weight_g)


def _corner(place: int, name: str) -> Dialogue[Press | None]:
    ask = f"Press the {name} corner with a finger, about as hard as a stiff doorbell, and hold it."
    held = yield from _wait(ask, lambda reading: _touched(reading) and corner_taxel(reading.zeroed[2]) is not None, 20)
    if held is None:
        return None
    mean = np.mean([reading.zeroed for reading in held], axis=0)
    taxel = corner_taxel(mean[2])
    if taxel is None:  # it moved from one corner to another
        return None
    before = mean[:2].sum(axis=(1, 2))

    def pushed(reading: Reading) -> bool:
        # 300 counts are about 0.2 N; noise of two counts a taxel sums up to eight.
        return _touched(reading) and bool(np.abs(_shear_counts(reading) - before).min() >= 300.0)

    felt = yield from _wait(
        "Still pressing, push towards the middle of the pad.", lambda reading: pushed(reading) or _free(reading), 10
    )
    push = None
    if felt is not None and pushed(felt[-1]):
        x, y = np.mean([_shear_counts(reading) for reading in felt], axis=0) - before
        push = (float(x), float(y))
    yield from _wait("Good. Let go." if push else "No push was measured. Let go.", _free, FREE_SCANS)
    return Press(place, taxel, float(mean[2].sum()), push)


def _mass_g() -> Dialogue[float | None]:
    """Ask for the mass of a weight, in [g]; None where there is none, or nobody answers."""
    request = ASK_WEIGHT
    while True:
        try:
            yield from _wait(request, lambda _: False, 1)
            return None
        except _TypedError as typed:
            line = str(typed).strip()
            if not line:
                return None
            mass_g = _number(line)
            if LIGHTEST_G <= mass_g <= HEAVIEST_G:
                return mass_g
            request = f"{line!r} is not a mass of {LIGHTEST_G} to {HEAVIEST_G} grams. {ASK_WEIGHT}"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _weigh(weight_g: float) -> Dialogue[Weighed | None]:
    """Return what a weight shows; None where nothing steady was laid on."""
    steady: list[NDArray[np.float32]] = []  # of z

    def lies_still(reading: Reading) -> bool:
        steady.append(reading.zeroed[2])
        del steady[:-STEADY_SCANS]
        if len(steady) < STEADY_SCANS:
            return False
        # Means of ten scans: usual noise of 4 counts a taxel spreads them over 12. The mean size of noise is a load.
        sums = np.sum(steady, axis=(1, 2)).reshape(-1, 10).mean(axis=1)
        return bool(abs(sums).min() > 100.0 and np.ptp(sums) < max(20.0, 0.02 * abs(sums).max()))

    ask = f"Lay {weight_g:g} g on the pad, flat and covering all of it, hands off."
    laid = yield from _wait(ask, lies_still, 1)
    if laid is None:
        return None
    mean = np.mean(steady[10:], axis=0)  # the oldest ten may hold the end of laying it down
    mean *= np.sign(mean.sum())
    covered = mean.min() >= LEAST_SHARE * mean.mean()
    yield from _wait("Good. Take it off.", _free, FREE_SCANS)
    return Weighed(float(mean.sum()) / (weight_g / 1000 * 9.80665), COVERED_ERROR if covered else PARTLY_ERROR)


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


def _shear_counts(reading: Reading) -> NDArray[np.float32]:
    """Return the sums of x and of y."""
    return reading.zeroed[:2].sum(axis=(1, 2))


def _touched(reading: Reading) -> bool:
    return bool(np.abs(reading.zeroed[2]).sum() >= ON_COUNTS)


def _free(reading: Reading) -> bool:
    return bool(np.abs(reading.zeroed[2]).sum() < OFF_COUNTS)
