"""Loss on pads other than the nominal one: each constant changed alone, with the same presses on every pad.

Shapes, poses, depths, drags, friction and every draw of the nuisances are the same on all pads, so that losses are
press by press. Half of the shapes are the paper's, half random figures.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple, cast

import joblib
import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.terminal.progress_bar import tracked
from train.data.frozen_presses import freeze_presses
from train.data.presses import SEED, PressSet, one_thread
from train.data.world import press_shapes
from train.experiments.sensor.shipped import ALL, NOTHING, SHORT, infer_presses
from train.experiments.workbench import Workbench
from train.families.catalogue import Tapped, draw_shape
from train.physics.gripped import MAX_INDENTATION_MM, GrippedPad
from train.physics.pad_draws import INPUTS, NOMINAL, Pad
from train.report import Report, Row, with_interval

SHAPES_SEED: Final = 4711
CONSTANTS: Final = (*INPUTS, "pitch_mm", "free_sides")
PERCENT: Final = (5, 10, 20)


class OffPad(NamedTuple):
    """Pad with one constant changed by percent of its nominal value, or of the whole free sides."""

    constant: str
    percent: int

    @property
    def pad(self) -> Pad:
        """Constants of the changed pad."""
        nominal = getattr(NOMINAL, self.constant)
        off = self.percent / 100 * (nominal if self.constant != "free_sides" else 1.0)
        return replace(NOMINAL, **{self.constant: nominal + off})

    @property
    def can_be(self) -> bool:
        """True where such a pad is possible: rubber does not swell when pressed, and sides do not push back."""
        return self.pad.poisson <= 0.499 and self.pad.free_sides >= 0


NONE_OFF: Final = OffPad("thickness_mm", 0)


def run(bench: Workbench, folder: Path) -> Path:
    """Make the presses, evaluate the models, and write the report `pads`."""
    percent, count = (PERCENT[-1:], 4) if bench.quick else (PERCENT, 40)
    names = CONSTANTS[:2] if bench.quick else CONSTANTS
    off = [OffPad(name, sign * part) for name in names for part in percent for sign in (-1, 1)]
    off = [NONE_OFF, *(one for one in off if one.can_be)]
    shapes = draw_shapes(count)
    pool = joblib.Parallel(n_jobs=-1, return_as="generator")
    jobs = cast(Iterator[PressSet], pool(joblib.delayed(pressed)(one.pad, shapes) for one in off))
    read = {one: freeze_presses(made, SEED) for one, made in zip(tracked(off, "pads", "pad"), jobs, strict=True)}
    model = bench.model()
    scores = {
        SHORT[known]: {
            one: psnr_db(infer_presses(model, frozen, known).patterns, frozen.patterns(), MAX_INDENTATION_MM)
            for one, frozen in read.items()
        }
        for known in (NOTHING, ALL)
    }
    report = Report("pads", folder, __file__, bench.used, quick=bench.quick)
    plain = {name: with_interval(psnr[NONE_OFF], np.arange(count)) for name, psnr in scores.items()}
    report.say(
        f"`{model.name}` (training {model.contract.training_sha256[:12]}), one tap; {count} shapes, "
        f"{count // 2} of the paper's surfaces and as many random figures, each pressed alike on every pad and read "
        "with the same draws of all nuisances. All else about a pad is nominal. PSNR on the nominal pad: "
        + "; ".join(f"{name} {value} dB" for name, value in plain.items())
        + ". Known: the constants that the model takes, and the gains; pitch and free sides it cannot be given. Free "
        "sides are off by percent of what finite elements give, upwards alone; a Poisson's ratio 20 % up cannot be."
    )
    rows = loss_rows(scores, list(read))
    report.table(rows, "PSNR lost against the nominal pad in dB, press by press, with 95 % intervals.")
    return report.write()


def loss_rows(scores: dict[str, dict[OffPad, NDArray[np.float64]]], off: list[OffPad]) -> list[Row]:
    """Return the loss of each method on each pad, down and up side by side."""
    rows: list[Row] = []
    for constant, percent in dict.fromkeys((one.constant, abs(one.percent)) for one in off if one.percent):
        row: Row = {"constant": constant, "off by %": percent}
        for name, psnr in scores.items():
            for word, sign in (("down", -1), ("up", 1)):
                lost = psnr.get(OffPad(constant, sign * percent))
                row[f"{name}, {word}"] = (
                    None if lost is None else with_interval(psnr[NONE_OFF] - lost, np.arange(len(lost)))
                )
        rows.append(row)
    return rows


def draw_shapes(count: int) -> list[tuple[str, Tapped]]:
    """Draw shapes under the pad with their families; all pads have the same cells, and so the same heights."""
    rng = np.random.default_rng(SHAPES_SEED)
    gripped, one_tap = GrippedPad(NOMINAL), np.zeros((1, 3))
    families = [("paper", "glyph", "paper", "polygon")[number % 4] for number in range(count)]
    return [(family, draw_shape(rng, family, gripped, one_tap)) for family in families]


@one_thread()
def pressed(pad: Pad, shapes: list[tuple[str, Tapped]]) -> PressSet:
    """Press all shapes onto one pad."""
    rng = np.random.default_rng(SHAPES_SEED + 1)
    families = np.array([family for family, _ in shapes])
    return press_shapes(rng, GrippedPad(pad), families, [shape for _, shape in shapes], 0)
