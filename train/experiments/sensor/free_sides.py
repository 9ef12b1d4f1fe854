"""Free sides of the pad: finite elements of the whole pad against the infinite layer, bare and corrected.

Where recordings exist, readings of grips of a box are compared with the rise towards the sides in these models.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.data.real_grips import recorded_sets, recording_paths, recordings_folder
from train.experiments.support.workbench import Workbench
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.magnets import MOVEMENT, Magnet, MagnetArray
from train.physics.side_correction import Drift, FreeSides, Give
from train.physics.taxel_response import IN_PLANE_SHARE, Skin
from train.report import Report, Row

POISSONS: Final = (0.45, 0.48, 0.49, 0.495)
PUNCH_MM: Final = 2.5
_CELL_MM: Final = USPA44.pixel_pitch_mm(10)
_SIZE: Final = 42
_CELLS_MM: Final = (np.arange(_SIZE) - (_SIZE - 1) / 2) * _CELL_MM
_PATCH: Final = 3
_MEANS: Final = np.kron(np.eye(_SIZE // _PATCH), np.full((1, _PATCH), 1 / _PATCH))
_SHALLOW_MM: Final = 0.1
_DIRECTIONS: Final = {"down": MOVEMENT.index("down_mm"), "out": MOVEMENT.index("right_mm"), "lean": 3}


def _contacts() -> dict[str, NDArray[np.bool_]]:
    """Return rigid flat faces as masks of the patches that they press, each (196,)."""
    x_mm, y_mm = (along.ravel() for along in np.meshgrid(_MEANS @ _CELLS_MM, _MEANS @ _CELLS_MM))

    def punch(at_x_mm: float, at_y_mm: float) -> NDArray[np.bool_]:
        return np.hypot(x_mm - at_x_mm, y_mm - at_y_mm) <= PUNCH_MM

    return {
        "whole face": np.ones_like(x_mm, dtype=bool),
        "punch in the middle": punch(0, 0),
        "punch 2 mm from a side": punch(8 - PUNCH_MM, 0),
        "punch across a side": punch(8.5, 0),
        "half the face": x_mm > 0,
        "punch in a corner": punch(7.05, 7.05),
    }


_CONTACTS: Final = _contacts()


class _Pads(NamedTuple):
    """Operators for one Poisson's ratio: compliances (196, 196) in [mm/MPa] and movement (16, 5, 196) per patch."""

    layer: Layer
    elements: NDArray[np.float64]
    elements_movement: NDArray[np.float64]
    bare: NDArray[np.float64]
    bare_movement: NDArray[np.floating]


def run(bench: Workbench, folder: Path) -> Path:
    """Repeat the fit, compare, and write the report."""
    from train.physics.whole_pad import WholePad  # here, because it needs FElupe

    report = Report("free_sides", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "Linear elements of the whole pad (20 x 20 x 4.5 mm, bonded below, free sides) under rigid faces, against the "
        "infinite layer that may be pressed on the pad's 42 x 42 cells only, bare and with `FreeSides(1)`. Pressures "
        "are of their mean; movement is of the magnets of a quarter (inner, edge, corner) per 1 mm of indentation, "
        "towards the board, outwards in x, and the lean in x; all of the in-plane movement."
    )
    flat_rows: list[Row] = []
    readings: list[Row] = _recorded_rows()
    pads, curves = [], {}
    for poisson in tracked(POISSONS[:1] if bench.quick else POISSONS, "free sides", "Poisson ratio"):
        layer = Layer(poisson=poisson)
        whole = WholePad(layer, 3 if bench.quick else 5)
        for name, bonded in (("elements, frictionless", False), ("elements, bonded face", True)):
            press = whole.flat(bonded)
            flat_rows.append(
                _flat_row(
                    poisson,
                    name,
                    press.stiffness_n_per_mm,
                    _at_places(press.nodes_mm, press.pressure[0]),
                    press.movement,
                )
            )
            readings.append(_reading_row(f"{poisson} {name}", _quarter_to_all(press.movement)))
            curves[poisson, name] = press.nodes_mm, press.pressure[0]
        for name, sides in (("infinite layer", None), ("infinite layer, FreeSides(1)", FreeSides())):
            pressure = _flat_pressure(layer, sides)
            stiffness = float(pressure.sum()) * _CELL_MM**2
            skin = Skin(USPA44, layer, _SIZE, _CELL_MM, in_plane_share=1.0, sides=sides)
            moved = skin.movement(pressure)
            line = pressure[_SIZE // 2, _SIZE // 2 :] / pressure.mean()
            curves[poisson, name] = _CELLS_MM[_SIZE // 2 :], line
            seen = _at_places(_CELLS_MM[_SIZE // 2 :], line)
            quarter = moved.reshape(4, 4, 5)[2:, 2:].reshape(4, 5)
            flat_rows.append(_flat_row(poisson, name, stiffness, seen, quarter))
            readings.append(_reading_row(f"{poisson} {name}", moved))
            share = moved * np.where(np.arange(5) < 2, IN_PLANE_SHARE, 1)
            readings.append(_reading_row(f"{poisson} {name}, {IN_PLANE_SHARE} of the in-plane movement", share))
        pads.append(_operators(layer, *whole.patches()))
    report.table(flat_rows, "Under a flat face larger than the pad.", "flat")

    sides = FreeSides()
    rows: list[Row] = []
    for pad in pads:
        for name in _CONTACTS:
            row: Row = {"Poisson": pad.layer.poisson, "contact": name}
            for kind, added in (("bare", 0.0), ("corrected", _compliance(sides, pad.layer))):
                stiffer, apart = _judge(pad, added, name)
                row |= {f"stiffness, {kind}": round(stiffer, 3), f"pressure apart, {kind}": round(apart, 3)}
            rows.append(row)
    report.table(rows, "Stiffness over the elements', and RMS difference of pressures over their RMS, by patches.")
    report.table(
        [{"Poisson": pad.layer.poisson} | _movement_row(pad, sides) for pad in pads],
        "RMS difference of the magnets' movement over its RMS, same pressures, bare -> corrected.",
        "movement",
    )
    found = _fitted(pads, sides, 2 if bench.quick else 60)
    report.table(
        [
            {"constant": name, "kept": str(kept), "fitted now": str(tuple(round(value, 4) for value in now))}
            for (name, kept), now in zip(_constants(sides).items(), _constants(found).values(), strict=True)
        ],
        "Constants: factor, then lengths in thicknesses, fitted to all Poisson ratios at once.",
        "constants",
    )
    report.say(
        "z by place, of the mean of z, with any tilt of the grip left in; outward: rise of x per column, and of y per "
        f"row, over the mean of z. Models: a flat face {_SHALLOW_MM} mm deep, through the magnets."
    )
    report.table(readings, "What a flat face reads: grips of a box, and models.", "readings")
    _plot(report, curves)
    return report.write()


def _flat_pressure(layer: Layer, sides: FreeSides | None) -> NDArray[np.float64]:
    solver = ContactSolver(layer, _SIZE, _CELL_MM, torch.float64, sides=sides)
    return solver.solve(np.zeros((1, _SIZE, _SIZE), dtype=np.float32), 1.0, 1e-4).pressure_mpa[0].astype(np.float64)


def _at_places(along_mm: NDArray[np.floating], pressure: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.interp([_CELLS_MM[_SIZE // 2], 1.5 * USPA44.pitch_mm, _CELLS_MM[-1]], along_mm, pressure)


def _flat_row(
    poisson: float, name: str, stiffness: float, pressure: NDArray[np.floating], movement: NDArray[np.floating]
) -> Row:
    places = {"inner": 0, "edge": 1, "corner": 3}
    row: Row = {"Poisson": poisson, "pad": name, "stiffness N/mm": round(stiffness, 1)}
    row |= {f"p at {at}": round(float(value), 2) for at, value in zip(("0", "7.05", "9.6 mm"), pressure, strict=True)}
    for name_, index in _DIRECTIONS.items():
        row[name_] = " ".join(f"{movement[place, index]:.3f}" for place in places.values())
    return row


def _quarter_to_all(movement: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return (16, 5) from a quarter's (4, 5), mirrored about both middle planes."""
    whole = np.empty((4, 4, 5))
    for sign_y, sign_x in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        rows, columns = (slice(2, 4) if sign > 0 else slice(1, None, -1) for sign in (sign_y, sign_x))
        whole[rows, columns] = movement.reshape(2, 2, 5) * np.array([sign_x, sign_y, 1, sign_x, sign_y])
    return whole.reshape(16, 5)


def _operators(layer: Layer, elements: NDArray[np.float64], movement: NDArray[np.float64]) -> _Pads:
    """Return the operators; the elements' mesh error, taken in the middle where no side acts, is corrected."""
    patches = np.zeros((len(elements), _SIZE, _SIZE))
    for patch, load in enumerate(patches):
        row, column = np.divmod(patch, len(_MEANS))
        load[_PATCH * row : _PATCH * (row + 1), _PATCH * column : _PATCH * (column + 1)] = 1
    down = ContactSolver(layer, _SIZE, _CELL_MM, torch.float64).displacement_mm(patches)
    bare = (_MEANS @ down @ _MEANS.T).reshape(elements.shape).T.astype(np.float64)
    moved = Skin(USPA44, layer, _SIZE, _CELL_MM, in_plane_share=1.0).movement(patches)
    middle = len(elements) // 2 + len(_MEANS) // 2
    near = (bare - elements)[middle]
    lacking = near[middle] - (near[middle + 2] + near[middle + 2 * len(_MEANS) + 2]) / 2
    return _Pads(layer, elements + lacking * np.eye(len(elements)), movement, bare, np.moveaxis(moved, 0, -1))


def _compliance(sides: FreeSides, layer: Layer) -> NDArray[np.float64]:
    """Return the compliance that the sides add, by patches, (196, 196) in [mm/MPa]."""
    across, along = sides.profiles(layer, _CELLS_MM)
    falls, bells = across @ _MEANS.T, _MEANS @ along @ _MEANS.T
    pairs = np.einsum("ksx,ksu->kxu", falls, falls) * (_PATCH * _CELL_MM) ** 2
    added = [np.kron(bell, pair) + np.kron(pair, bell) for bell, pair in zip(bells, pairs, strict=True)]
    return np.sum(added, axis=0)


def _pressed(compliance: NDArray[np.float64], contact: str) -> NDArray[np.float64]:
    touching = _CONTACTS[contact]
    pressure = np.zeros(len(touching))
    pressure[touching] = np.linalg.solve(compliance[np.ix_(touching, touching)], np.ones(touching.sum()))
    return pressure


def _judge(pad: _Pads, added: NDArray[np.float64] | float, contact: str) -> tuple[float, float]:
    truth, found = _pressed(pad.elements, contact), _pressed(pad.bare + added, contact)
    shape, wanted = found / found.sum(), truth / truth.sum()
    return float(found.sum() / truth.sum()), float(np.linalg.norm(shape - wanted) / np.linalg.norm(wanted))


def _loads(pad: _Pads) -> NDArray[np.float64]:
    """Return the contacts' pressures of force one, and half of each patch alone, (196, loads)."""
    pressed = np.stack([_pressed(pad.elements, name) for name in _CONTACTS], axis=1)
    return np.concatenate([pressed / pressed.sum(axis=0), 0.5 * np.eye(len(pressed))], axis=1)


def _left(pad: _Pads, sides: FreeSides | None, direction: str) -> NDArray[np.float64]:
    """Return the unexplained movement over the RMS of all movement, (taxels, loads)."""
    axis, loads = _DIRECTIONS[direction], _loads(pad)
    missing = pad.elements_movement[:, axis] - pad.bare_movement[:, axis]
    if sides is not None:
        added = sides.movement(pad.layer, _CELLS_MM, USPA44.taxel_centres_mm())[:, axis]
        missing = missing - (_MEANS @ added @ _MEANS.T).reshape(missing.shape) * (_PATCH * _CELL_MM) ** 2
    return missing @ loads / np.sqrt(np.mean((pad.elements_movement[:, axis] @ loads) ** 2))


def _movement_row(pad: _Pads, sides: FreeSides) -> Row:
    def rms(values: NDArray[np.float64]) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return {name: f"{rms(_left(pad, None, name)):.3f} -> {rms(_left(pad, sides, name)):.3f}" for name in _DIRECTIONS}


def _fitted(pads: list[_Pads], start: FreeSides, most: int) -> FreeSides:
    """Return the constants that explain the elements of all pads best, starting from the kept ones."""

    def fit(values: NDArray[np.float64], left: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> list[float]:
        return least_squares(left, values, x_scale=np.abs(values), max_nfev=most).x.tolist()

    def with_gives(values: NDArray[np.float64] | list[float]) -> FreeSides:
        return replace(start, gives=tuple(Give(*term) for term in np.reshape(values, (-1, 3)).tolist()))

    def surface(values: NDArray[np.float64]) -> NDArray[np.float64]:
        sides = with_gives(values)
        compared = [_judge(pad, _compliance(sides, pad.layer), name) for pad in pads for name in _CONTACTS]
        return np.array([(np.log(stiffer), apart / 2) for stiffer, apart in compared]).ravel()

    found = with_gives(fit(np.ravel(start.gives), surface))
    for name in _DIRECTIONS:

        def inside(values: NDArray[np.float64], name: str = name) -> NDArray[np.float64]:
            sides = replace(start, **{name: Drift(*values)})
            return np.concatenate([_left(pad, sides, name).ravel() for pad in pads])

        found = replace(found, **{name: Drift(*fit(np.array(getattr(start, name)), inside))})
    return found


def _constants(sides: FreeSides) -> dict[str, tuple[float, ...]]:
    gives = {f"surface, term {number + 1}": tuple(give) for number, give in enumerate(sides.gives)}
    return gives | {f"magnets, {name}": tuple(getattr(sides, name)) for name in _DIRECTIONS}


def _reading_row(name: str, movement: NDArray[np.floating]) -> Row:
    field = MagnetArray(USPA44, Magnet()).change_mt(_SHALLOW_MM * movement)
    return _places_row(name, field.T.reshape(USPA44.scan_shape))


def _places_row(name: str, scan: NDArray[np.floating]) -> Row:
    z = scan[2] / scan[2].mean()
    columns = np.arange(USPA44.cols) - (USPA44.cols - 1) / 2
    slope = columns / (USPA44.rows * (columns**2).sum())
    outward = [float((scan[0] @ slope).sum()), float((slope @ scan[1]).sum())]
    inner, corner = z[1:3, 1:3].mean(), z[::3, ::3].mean()
    row: Row = {"flat face on": name, "z inner": round(float(inner), 2)}
    row |= {"z edge": round(float(2 - (inner + corner) / 2), 2), "z corner": round(float(corner), 2)}
    return row | {
        f"{axis} outward": round(value / float(scan[2].mean()), 3) for axis, value in zip("xy", outward, strict=True)
    }


def _recorded_rows() -> list[Row]:
    folder = recordings_folder()
    if not recording_paths(folder):
        return []
    return [
        _places_row(f"real: {scans.sensor}, trial {number + 1}", scans.counts.mean(axis=0))
        for number, scans in enumerate(recorded_sets(folder))
    ]


def _plot(report: Report, curves: dict[tuple[float, str], tuple[NDArray[np.floating], NDArray[np.floating]]]) -> None:
    poissons = list(dict.fromkeys(poisson for poisson, _ in curves))
    with report.figure(size=(3.2 * len(poissons), 3.4)) as figure:
        grid = figure.subplots(1, len(poissons), sharey=True, squeeze=False)[0]
        for axes, poisson in zip(grid, poissons, strict=True):
            for (of, name), (at_mm, pressure) in curves.items():
                if of == poisson:
                    axes.plot(at_mm, pressure, "--" if "elements" in name else "-", label=name)
            axes.set(title=f"Poisson {poisson}", xlabel="from the centre, mm", ylim=(0, 2.5))
        grid[0].set_ylabel("pressure / mean, y = 0")
        grid[0].legend(fontsize=6)
