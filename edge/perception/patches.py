"""Separate contacts under one pad, as patches of its pattern, and what happens to each of them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.inference.contract import Contract
from edge.perception.pattern_description import touched
from edge.perception.result import Result
from edge.validation import check_positive

PatchEventKind = Literal["begin", "move", "slip", "end"]
SCANS: Final = 3  # results in a row by which a contact begins or ends
REACH_MM: Final = 4.0  # way of a contact from one result to the next; further away it is another one


@dataclass(frozen=True, slots=True)
class Patch:
    """One connected area of touch, on the axes of the pad: origin in the middle of its face, x right, y down."""

    area_mm2: float  # of the touched pixels
    centre_mm: tuple[float, float]  # x, y of the middle of its pattern
    force_n: tuple[float, float, float] | None  # x, y, z of its share of the traction; None of a model without
    normal: tuple[float, float, float]  # of the touched surface, into the pad, by the plane through its pattern
    long_axis_deg: float  # direction of its longer axis from x to y, -90 to 90
    size_mm: tuple[float, float]  # length along that axis and width across, four standard deviations each
    trusted: bool | None  # as the result's

    @property
    def shear_ratio(self) -> float | None:
        """Tangential over normal force; None where neither is known, or nothing presses."""
        if self.force_n is None or self.force_n[2] <= 0:
            return None
        return math.hypot(*self.force_n[:2]) / self.force_n[2]


def patches(result: Result, contract: Contract) -> list[Patch]:
    """Return the contacts of a result, the strongest first; none without a pattern.

    A patch with less than a twentieth of all the pattern is left out: networks draw such specks where nothing is.
    """
    if result.pattern is None:
        return []
    pattern, pixel_mm = result.pattern, contract.pitch_mm / contract.scale
    labels, count = _labelled(touched(pattern, contract.contact_level))
    volume = np.bincount(labels.ravel(), pattern.ravel(), count + 1)[1:]
    masks = [labels == index + 1 for index in np.argsort(-volume) if volume[index] >= 0.05 * volume.sum()]
    forces = _forces(result, [pattern * mask for mask in masks], contract)
    return [_patch(pattern, mask, pixel_mm, force, result) for mask, force in zip(masks, forces, strict=True)]


def _patch(
    pattern: NDArray[np.float32],
    mask: NDArray[np.bool_],
    pixel_mm: float,
    force_n: tuple[float, float, float] | None,
    result: Result,
) -> Patch:
    rows, columns = np.nonzero(mask)
    depth = pattern[mask].astype(np.float64)
    places = np.stack([columns, rows], axis=1) - (np.array(pattern.shape[::-1]) - 1) / 2
    places, share = places * pixel_mm, depth / depth.sum()
    centre = share @ places
    away = places - centre
    spread = (away * share[:, None]).T @ away + np.eye(2) * pixel_mm**2 / 12  # a pixel has a width, too
    widths, axes = np.linalg.eigh(spread)
    x, y = axes[:, 1]
    # Weights keep the blurred edge of a patch from tilting its plane.
    slope = np.linalg.solve(spread, (away * (share * (depth - share @ depth))[:, None]).sum(axis=0))
    normal = np.array([-slope[0], -slope[1], 1.0]) / math.hypot(*slope, 1.0)
    angle_deg = math.degrees(math.atan2(y, x))
    return Patch(
        area_mm2=len(depth) * pixel_mm**2,
        centre_mm=(float(centre[0]), float(centre[1])),
        force_n=force_n,
        normal=(float(normal[0]), float(normal[1]), float(normal[2])),
        long_axis_deg=(angle_deg + 90) % 180 - 90,
        size_mm=(4 * math.sqrt(widths[1]), 4 * math.sqrt(widths[0])),
        trusted=result.trusted,
    )


def _forces(
    result: Result, parts: list[NDArray[np.float32]], contract: Contract
) -> list[tuple[float, float, float] | None]:
    """Return the force of each patch: traction goes to the patches by their pattern there, else to the nearest one."""
    if result.traction is None or not parts:
        return [None] * len(parts)
    height, width = result.traction.shape[1:]
    blocks = np.stack([part.reshape(height, len(part) // height, width, -1).sum(axis=(1, 3)) for part in parts])
    everywhere = blocks.sum(axis=0)
    places = np.indices((height, width))
    centres = [(places * block).sum(axis=(1, 2), keepdims=True) / block.sum() for block in blocks]
    nearest = np.argmin([((places - centre) ** 2).sum(axis=0) for centre in centres], axis=0)
    alone = np.arange(len(parts))[:, None, None] == nearest
    shares = np.divide(blocks, everywhere, out=alone.astype(blocks.dtype), where=everywhere > 0)
    newtons_of_kpa = 1e-3 * (contract.rows * contract.pitch_mm / height) * (contract.cols * contract.pitch_mm / width)
    forces = newtons_of_kpa * np.einsum("phw,ahw->pa", shares, result.traction, dtype=np.float64)
    return [(x, y, z) for x, y, z in forces.tolist()]


def _labelled(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], int]:
    """Return labels (H, W), 0 outside and 1 to n in areas that are connected by edges, and n: by runs of the rows."""
    labels, parents = np.zeros(mask.shape, dtype=np.intp), [0]

    def root(label: int) -> int:
        while parents[label] != label:
            label = parents[label]
        return label

    before: list[tuple[int, int, int]] = []
    for row, line in enumerate(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8)):
        edges = np.flatnonzero(np.diff(line)).tolist()
        runs = []
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            met = {root(label) for first, last, label in before if first < stop and last > start}
            label = min(met) if met else len(parents)
            if not met:
                parents.append(label)
            for other in met:
                parents[other] = label
            labels[row, start:stop] = label
            runs.append((start, stop, label))
        before = runs
    roots = [root(label) for label in range(len(parents))]
    numbers = {label: number for number, label in enumerate(dict.fromkeys(roots))}
    return np.array([numbers[label] for label in roots])[labels], len(numbers) - 1


class PatchEvent(NamedTuple):
    """Change of a contact: its number since the start, and its patch; of an end the last one."""

    kind: PatchEventKind
    number: int
    patch: Patch


class PatchEvents:
    """Follower of one sensor's contacts from result to result; patterns that are not believed count for nothing.

    A contact begins once it was there for SCANS results in a row, and ends once it was missing for as many; it moves
    by `move_mm` from where it was when that was last reported; it slips where its shear over its normal force reaches
    `slip_ratio`, and again only after it has fallen to four fifths of it. Raises UsageError if one is not positive.
    """

    def __init__(self, contract: Contract, *, slip_ratio: float = 0.5, move_mm: float = 1.0) -> None:
        check_positive("slip_ratio", slip_ratio)  # one that is NaN would never be reached
        check_positive("move_mm", move_mm)
        self._contract, self._slip_ratio, self._move_mm = contract, slip_ratio, move_mm
        self._followed: list[_Followed] = []
        self._begun = 0

    def __call__(self, result: Result) -> list[PatchEvent]:
        """Return what has happened by this result."""
        if result.contact is None or result.state == "dropped" or result.trusted is False:
            return []
        free = patches(result, self._contract)
        events: list[PatchEvent] = []
        for contact in self._followed:
            near = min(free, key=contact.distance_mm, default=None)
            if near is None or contact.distance_mm(near) > REACH_MM:
                contact.missing += 1
                continue
            free.remove(near)
            contact.patch, contact.seen, contact.missing = near, contact.seen + 1, 0
            events += self._changes(contact)
        over = [contact for contact in self._followed if self._is_over(contact)]
        events += [PatchEvent("end", contact.number, contact.patch) for contact in over if contact.number]
        going_on = [contact for contact in self._followed if not self._is_over(contact)]
        self._followed = going_on + [_Followed(patch) for patch in free]
        return events

    def _is_over(self, contact: "_Followed") -> bool:
        return contact.missing >= (SCANS if contact.number else 1)

    def _changes(self, contact: "_Followed") -> Iterator[PatchEvent]:
        if not contact.number and contact.seen >= SCANS:
            self._begun += 1
            contact.number, contact.reported_mm = self._begun, contact.patch.centre_mm
            yield PatchEvent("begin", contact.number, contact.patch)
        if not contact.number:
            return
        if math.dist(contact.reported_mm, contact.patch.centre_mm) >= self._move_mm:
            contact.reported_mm = contact.patch.centre_mm
            yield PatchEvent("move", contact.number, contact.patch)
        ratio = contact.patch.shear_ratio
        if ratio is not None and not contact.slipping and ratio >= self._slip_ratio:
            contact.slipping = True
            yield PatchEvent("slip", contact.number, contact.patch)
        elif ratio is not None and ratio <= 0.8 * self._slip_ratio:
            contact.slipping = False


@dataclass
class _Followed:
    """A contact that is followed; its number is 0 until it has begun."""

    patch: Patch
    number: int = 0
    seen: int = 1
    missing: int = 0
    reported_mm: tuple[float, float] = (0.0, 0.0)
    slipping: bool = False

    def distance_mm(self, other: Patch) -> float:
        return math.dist(self.patch.centre_mm, other.centre_mm)
