"""The shipped model on every family of shapes on unseen pads, and on pads off the nominal one.

Of pads each constant is changed alone. Shapes, poses, depths, drags, friction and every draw of the nuisances are then
the same on all pads, so that losses are press by press.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from timeit import repeat
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import Method, fitted_methods
from edge.evaluation.metrics import psnr_db
from edge.evaluation.test_set import judge
from edge.inference.bundled import BUNDLE_DIR
from edge.inference.intervals import REGIONS, half_widths_mm, near_pixels, regions
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.press_batches import in_units, read_presses
from train.data.presses import SEED, one_thread
from train.data.world import World, press_shapes
from train.experiments.workbench import SHORT, Inferred, Workbench, infer_presses, name_of
from train.families.catalogue import SHARES, Tapped, draw_shape
from train.learning.checkpoint import best_contact_level
from train.physics.gripped import MAX_INDENTATION_MM, SCALE, GrippedPad
from train.physics.pad_draws import INPUTS, NOMINAL, Pad
from train.physics.sensor_noise import Nuisances
from train.report import Report, Row, with_interval

TRAINING: Final = World(count=24_000, per_pad=48, seed=67)  # settings of data/gripped.npz in the Makefile
_LEVELLED: Final = 2000  # training presses by which the level of contact of a baseline is chosen
_BEST: Final = "linear map"  # of the baselines on validation presses
_LEVEL: Final = "90"
_NEAREST: Final = 8
_AT_ONCE: Final = 64


def families(bench: Workbench, report: Report) -> None:
    """Evaluate the shipped model and its intervals on every family, next to baselines."""
    wide = bench.wide_test()
    model = bench.model()
    fitted = fitted_methods(bench.use(BUNDLE_DIR / "classical.npz"), SCALE)
    training = bench.presses("gripped", TRAINING)
    read = read_presses(training.with_taps(1), Nuisances(), SEED)[:, 0]
    baselines = {name: fitted[name] for name in ("bilinear", _BEST)}
    baselines |= {f"nearest {_NEAREST}": nearest_presses(read, training.patterns)}
    inferred = {name: infer_presses(model, wide, known) for known, name in SHORT.items()}
    frozen, own = wide.as_frozen_set(), model.contract.contact_level
    found = {name: judge(one.patterns, frozen, own) for name, one in inferred.items()}
    times_us = {name: one.run_time_us for name, one in inferred.items()}
    for name, run in tracked(baselines.items(), "judging", "baseline"):
        newest = wide.windows(1)[:, 0]
        level = best_contact_level(run(read[:_LEVELLED]), training.touching[:_LEVELLED])
        times_s = [min(repeat(partial(run, scan[None]), number=1, repeat=3)) for scan in newest[:100]]
        found[name], times_us[name] = judge(run(newest), frozen, level), 1e6 * float(np.median(times_s))

    report.say(
        f"{name_of(model)}, through the runtime's session, one tap. "
        f"Wide test set: {len(wide)} presses of {len(np.unique(wide.presses.family))} families, as many of each, on "
        f"{len(np.unique(wide.presses.pad))} pads that nothing was trained on or chosen by, sha256 "
        f"{wide.presses.sha256()[:12]}. Full scale {MAX_INDENTATION_MM} mm. 95 % intervals are by pad. Known: all "
        "constants of the pad that a sensor file holds, and the taxels' gains. Baselines see the newest tap and are "
        "fitted on training presses, as sensors of their own read them, which choose their levels of contact, too: "
        f"bilinear by one gain, the linear map by ridge regression, the mean of the {_NEAREST} presses of nearest "
        f"readings. Best of them on validation presses: {_BEST}. Run time: median of a scan, one thread."
    )
    truth, pads = wide.patterns(), wide.presses.pad
    rows: list[Row] = [
        {
            "method": name,
            "PSNR dB": with_interval(figures["psnr_db"], pads),
            "IoU": round(float(figures["contact_iou"].mean()), 3),
            "edge mm": round(float(figures["boundary_mm"].mean()), 3),
            "RMSE %": round(float(figures["rmse_percent"].mean()), 2),
            "run time us": round(times_us[name]),
        }
        for name, figures in found.items()
    ]
    report.table(rows, "All families.")
    report.table(_family_rows(found, wide), f"PSNR in dB by family; `over` is over {_BEST}, press by press.")
    if _LEVEL in model.contract.interval_levels:
        text = f"Pixels whose truth the {_LEVEL} % interval holds, in %, by region of the predicted pattern."
        report.table(_interval_rows(model, inferred, truth, wide), text)


def nearest_presses(known: NDArray[np.float32], patterns: NDArray[np.float16]) -> Method:
    """Return the method that gives the mean pattern of the known presses with the nearest readings, in network units.

    Readings are (n, 3, rows, cols) in zeroed counts, patterns (n, H, W) in [mm].
    """
    held = in_units(known).reshape(len(known), -1)
    squares = np.square(held).sum(axis=1)

    def nearest(newest: NDArray[np.floating]) -> NDArray[np.floating]:
        found = []
        for asked in np.array_split(in_units(newest.astype(np.float32)), -(-len(newest) // _AT_ONCE)):
            apart = squares - 2 * asked.reshape(len(asked), -1) @ held.T
            those = np.argpartition(apart, _NEAREST - 1, axis=1)[:, :_NEAREST]
            found.append(patterns[those].mean(axis=1, dtype=np.float32))
        return np.concatenate(found)

    return nearest


def _family_rows(found: Mapping[str, Mapping[str, NDArray[np.float64]]], wide: FrozenPresses) -> list[Row]:
    """Return the PSNR of every method by family and in total, and the model's margin over the best baseline."""
    rows: list[Row] = []
    for family, which in _families(wide):
        found_db = {name: figures["psnr_db"][which] for name, figures in found.items()}
        pads = wide.presses.pad[which]
        row: Row = {"family": family, "presses": int(which.sum())}
        for name, values in found_db.items():
            row[name] = with_interval(values, pads) if name in SHORT.values() else round(float(values.mean()), 2)
        for name in SHORT.values():
            row[f"{name}, over"] = with_interval(found_db[name] - found_db[_BEST], pads)
        rows.append(row)
    return rows


def _interval_rows(
    model: ModelSession, inferred: Mapping[str, Inferred], truth: NDArray[np.float32], wide: FrozenPresses
) -> list[Row]:
    """Return the share of pixels that the model's intervals hold, by region: of all presses, and by family."""
    contract, rows = model.contract, list[Row]()
    for name, one in inferred.items():
        region = regions(one.patterns, contract.contact_level, near_pixels(contract.scale, contract.pitch_mm))
        widths_mm = half_widths_mm(contract.interval_levels, _LEVEL, one.deviations, region)
        held = 100.0 * (np.abs(one.patterns - truth) <= widths_mm)
        pads = np.broadcast_to(wide.presses.pad[:, None, None], region.shape)
        for family, which in _families(wide) if name == SHORT[False] else [("all", np.ones(len(wide), dtype=bool))]:
            row: Row = {"family": family, "method": name}
            for number, place in enumerate(REGIONS):
                here = (region == number) & which[:, None, None]
                row[place] = with_interval(held[here], pads[here], 1) if here.any() else None
            rows.append(row)
    return rows


def _families(wide: FrozenPresses) -> list[tuple[str, NDArray[np.bool_]]]:
    """Return names in the order of SHARES with a mask of each family's presses; `all` comes last."""
    family = wide.presses.family
    some = [(name, family == name) for name in SHARES if (family == name).any()]
    return [*some, ("all", np.ones(len(wide), dtype=bool))]


SHAPES_SEED: Final = 4711
CONSTANTS: Final = (*INPUTS, "pitch_mm", "free_sides")
PERCENT: Final = (5, 10, 20)  # of a constant's nominal value, or of the whole free sides


def pads(bench: Workbench, report: Report) -> None:
    """Evaluate the shipped model on pads that are off the nominal one."""
    percent, names, count = (PERCENT[-1:], CONSTANTS[:2], 4) if bench.quick else (PERCENT, CONSTANTS, 40)
    shapes, model, every = draw_shapes(count), bench.model(), np.arange(count)
    plain = _psnr_db(model, NOMINAL, shapes)
    rows: list[Row] = []
    for constant, part in tracked(list(product(names, percent)), "pads", "constant"):
        cells: Row = {"constant": constant, "off by %": part}
        for word, sign in (("down", -1), ("up", 1)):
            nominal = getattr(NOMINAL, constant)
            off = sign * part / 100 * (nominal if constant != "free_sides" else 1.0)
            pad = replace(NOMINAL, **{constant: nominal + off})
            # Rubber does not swell when pressed, and sides do not push back.
            found = _psnr_db(model, pad, shapes) if pad.poisson <= 0.499 and pad.free_sides >= 0 else {}
            for name, psnr_db_of in plain.items():
                cells[f"{name}, {word}"] = with_interval(psnr_db_of - found[name], every) if found else None
        rows.append(cells)
    report.say(
        f"{name_of(model)}, one tap; {count} shapes, "
        f"{count // 2} of the paper's surfaces and as many random figures, each pressed alike on every pad and read "
        "with the same draws of all nuisances. All else about a pad is nominal. PSNR on the nominal pad: "
        + "; ".join(f"{name} {with_interval(values, every)} dB" for name, values in plain.items())
        + ". Known: the constants that the model takes, and the gains; pitch and free sides it cannot be given. Free "
        "sides are off by percent of what finite elements give, upwards alone; a Poisson's ratio 20 % up cannot be."
    )
    report.table(rows, "PSNR lost against the nominal pad in dB, press by press, with 95 % intervals.")


def draw_shapes(count: int) -> list[tuple[str, Tapped]]:
    """Draw shapes under the pad with their families; all pads have the same cells, and so the same heights."""
    rng = np.random.default_rng(SHAPES_SEED)
    gripped, one_tap = GrippedPad(NOMINAL), np.zeros((1, 3))
    families = [("paper", "glyph", "paper", "polygon")[number % 4] for number in range(count)]
    return [(family, draw_shape(rng, family, gripped, one_tap)) for family in families]


@one_thread()
def _psnr_db(model: ModelSession, pad: Pad, shapes: list[tuple[str, Tapped]]) -> dict[str, NDArray[np.float64]]:
    """Return the PSNR of each shape on a pad, (n,), with nothing and all known of it."""
    rng, families = np.random.default_rng(SHAPES_SEED + 1), np.array([family for family, _ in shapes])
    pressed = press_shapes(rng, GrippedPad(pad), families, [shape for _, shape in shapes])
    frozen = freeze_presses(pressed, SEED)
    return {
        name: psnr_db(infer_presses(model, frozen, known).patterns, frozen.patterns(), MAX_INDENTATION_MM)
        for known, name in SHORT.items()
    }
