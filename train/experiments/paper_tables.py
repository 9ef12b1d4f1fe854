"""The paper's protocol, and its Tables III and IV, and Figs. 12, 13 and 16: the error by what is changed in each."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import CONTACT_LEVEL, bilinear, fit_gain
from edge.evaluation.test_set import FrozenSet, judge
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.data.presses import PressSet, join_presses
from train.data.world import World
from train.experiments.workbench import Method, Workbench, median_ms
from train.fit import given_taps
from train.freeze import drawn
from train.learning.checkpoint import Training
from train.learning.training_loop import Recipe
from train.physics.gripped import FINE_SCALE, SCALE
from train.report import Report, Row, with_interval
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import ANGLE_STEP_DEG, MAX_TAPS

HELD_OUT: Final = ("S", "hollow circle", "hollow triangle")  # surfaces that Fig. 16 leaves out of a training.
KNOWN: Final = tuple(name for name in SURFACES if name not in HELD_OUT)
_SET: Final = World(taps=MAX_TAPS, schedule="turns", spread=0.0, scale=FINE_SCALE)
SETS: Final = {
    "known": replace(_SET, families=dict.fromkeys(KNOWN, 1.0), count=7500, seed=1),
    "held-out": replace(_SET, families=dict.fromkeys(HELD_OUT, 1.0), count=1500, seed=2),
    "figures": replace(_SET, families={"glyph": 1.0, "polygon": 1.0}, count=9000, seed=3),
}
"""Presses by the nominal pad, turned from tap to tap: of the 15 other surfaces, of those three, of random figures."""

_PASS: Final = 1125  # steps of the paper's networks in batches of 16: one pass over the data, 15 minutes for the STSR
BASE: Final = Training("taps-stsr", "compact-stsr", Recipe(steps=16_000, bf16=True))


def presses(bench: Workbench, name: str) -> PressSet:
    """Return one of SETS, with the truth at x20."""
    return bench.presses(f"paper-{name}", SETS[name], MAX_TAPS)


def mixed(bench: Workbench, scale: int = SCALE) -> PressSet:
    """Return the mixed data, the 18 surfaces and as many random figures, with the truth at a scale."""
    return join_presses([presses(bench, name) for name in SETS]).at_scale(scale)


def from_base(name: str, taps: int, steps: int, scale: int = SCALE) -> Training:
    """Return the training of a network from the base's trunk; at another scale its output layers are new."""
    recipe = Recipe(steps=steps, learning_rate=1e-3, given=given_taps(taps))
    network, seed = ("compact-stsr", 1) if taps == 1 else (f"fusion-mtsr{taps}", 1 + taps)
    return Training(f"taps-{name}", network, recipe, scale, BASE.name, seed)


FUSED: Final = from_base("fused", MAX_TAPS, 2000)  # of one to seven taps, at the poses of the paper's schedule


def published(name: str) -> Training:
    """Return the training of a network of the paper: SRGAN on top of SRCNN, every MTSR-K on top of the STSR.

    `stsr longer` is trained on for as long as MTSR-2 from the STSR, so that the two differ by the second tap alone.
    """
    network, _, longer = name.partition(" ")
    taps = int(network.removeprefix("mtsr")) if network.startswith("mtsr") else 1
    start = "seed-srcnn" if network == "srgan" else "seed-stsr" if taps > 1 or longer else None
    given, steps = given_taps(taps), _PASS // 4 if start == "seed-stsr" else _PASS
    recipe = Recipe(steps, batch=16, learning_rate=5e-4, weight_decay=1e-2, given=given, bf16=True)
    return Training(f"seed-{name}", network, recipe, start=start)


_STARTS: Final = {start.name: start for start in (BASE, published("stsr"), published("srcnn"))}


def trained(bench: Workbench, training: Training, data: PressSet, validation: FrozenSet) -> Method:
    """Return a trained network; the network that it starts from is trained first."""
    if training.start:
        bench.fit(_STARTS[training.start], data, validation)
    return bench.network(training, data, validation)


def bilinear_method(data: PressSet) -> Method:
    """Return bilinear interpolation with a gain that is fitted on windows of `data`."""
    newest, patterns = drawn(data, 2000)
    gain = fit_gain(bilinear(newest[:, 2], SCALE), patterns)

    def run(windows: NDArray[np.floating]) -> NDArray[np.float64]:
        return gain * bilinear(windows[:, 0, 2], SCALE)

    scan = np.zeros((1, 1, *USPA44.scan_shape), dtype=np.float32)
    return Method("bilinear", 1, CONTACT_LEVEL, run, {"parameters": 1, "run time ms": median_ms(partial(run, scan))})


def judged(
    head: Row,
    method: Method,
    sets: Mapping[str, FrozenSet],
    given: int | None = None,
    alone_db: NDArray[np.float64] | None = None,
) -> tuple[Row, NDArray[np.float64]]:
    """Return the row of a method with its errors on each set, and the PSNR in [dB] of every frame of the last, (n,).

    The method gets the newest `given` taps, or all that it uses; `alone_db` is that of the STSR, to state the gain.
    """
    row, found_db = dict(head), np.empty(0)
    for split, frozen in sets.items():
        figures = judge(method.run(frozen.windows(method.taps, given)), frozen, method.contact_level)
        row[f"{split} PSNR dB"] = with_interval(figures["psnr_db"], frozen.tap)
        row[f"{split} SSIM"] = round(float(figures["ssim"].mean()), 4)
        found_db = figures["psnr_db"]
        if alone_db is not None:
            row["over STSR dB"] = with_interval(found_db - alone_db, frozen.tap, sign="+")
    return row | method.cost, found_db


PUBLISHED: Final = ("srcnn", "srgan", "stsr", *(f"mtsr{taps}" for taps in range(2, MAX_TAPS + 1)), "stsr longer")
SCALES: Final = (4, 6, 8, 10, 20)
COMPARED: Final = (
    *(("compact stsr", "stsr"), ("fusion, 4 taps", "mtsr4")),
    *(("mtsr2", "stsr longer"), ("fusion, 2 taps", "compact stsr")),
)
ONE_IN: Final = 8  # step between evaluated frames of a tap


def table3(bench: Workbench, report: Report) -> None:
    """Compare all methods on the same targets at x10: Table III."""
    data, validation = mixed(bench), bench.frozen("validation")
    sets = {"validation": validation.thinned(ONE_IN), "test": bench.frozen("test").thinned(ONE_IN)}
    names = ("srgan", "stsr", "mtsr2", "stsr longer") if bench.quick else PUBLISHED
    # The paper's networks, which are large, are calibrated on few frames.
    networks = [(name, published(name), sets["validation"]) for name in names]
    networks += [("compact stsr", BASE, validation)]
    networks += [(f"fusion, {taps} taps", FUSED, validation) for taps in (2, 4, MAX_TAPS)]
    compared = {"bilinear": bilinear_method(data)}
    for name, training, calibrated_on in tracked(networks, "networks", "network"):
        compared[name] = trained(bench, training, data, calibrated_on)
    test, rows, test_db = sets["test"], list[Row](), dict[str, NDArray[np.float64]]()
    for name, method in compared.items():
        given = int(name.split()[1]) if name.startswith("fusion") else None
        row, test_db[name] = judged({"method": name}, method, sets, given)
        rows.append(row)
    report.say(
        f"{len(test)} frames of {len(test.surface)} taps a set, one in {ONE_IN} evenly over each tap, the same for "
        f"every row; full scale {test.full_scale_mm} mm. PSNR with its 95 % interval by tap. Run time: one window, "
        f"torch, one thread. All are trained on the same {len(data)} sequences, the paper's networks in one pass over "
        f"them, an MTSR and the longer STSR in a quarter more; compact STSR in {BASE.recipe.steps} steps of "
        f"{BASE.recipe.batch}, and its fusion in {FUSED.recipe.steps} more."
    )
    verdicts = [
        f"- {better} over {worse} [dB]: {with_interval(test_db[better] - test_db[worse], test.tap, sign='+')}"
        for better, worse in COMPARED
        if {better, worse} <= set(test_db)
    ]
    report.say("On the test set, tap by tap:\n\n" + "\n".join(verdicts))
    report.table(rows, "Validation and test set, x10.")


def table4(bench: Workbench, report: Report) -> None:
    """Compare the compact STSR at five scales, each against the truth at that scale: Table IV."""
    rows: list[Row] = []
    bench.fit(BASE, mixed(bench), bench.frozen("validation"))  # at its own scale
    for scale in tracked(SCALES, "scales", "scale"):
        sets = {split: bench.frozen(split, scale=scale) for split in ("validation", "test")}
        training = BASE if scale == BASE.scale else from_base(f"stsr-x{scale}", 1, 2500, scale)
        method = bench.network(training, mixed(bench, scale), sets["validation"])
        pattern = "{} x {}".format(*sets["test"].unit_patterns.shape[1:])
        rows.append(judged({"scale": f"x{scale}", "pattern": pattern}, method, sets)[0])
    report.say(
        "The compact STSR. Truth is made at x20 and brought to each scale with anti-aliasing. At x10 the layers that"
        " make pixels are as old as the base network, at the other scales they are trained from nothing for the last"
        " steps alone: compare those with each other."
    )
    report.table(rows, "STSR by scale.")


def angle(bench: Workbench, report: Report) -> None:
    """Compare the paper's MTSR-2 for each angle between its taps, on taps turned by that angle: Fig. 12."""
    stsr = trained(bench, published("stsr"), mixed(bench), bench.frozen("validation").thinned(ONE_IN))
    row, alone_db = judged({"network": "STSR", "angle deg": None}, stsr, {"test": bench.frozen("test")})
    rows = [row]
    for angle_deg in tracked((5.0, 10.0, 15.0, 20.0, 25.0, 30.0), "angles", "angle"):
        validation, turned = (bench.frozen(split, angle_step_deg=angle_deg) for split in ("validation", "test"))
        training = replace(published("mtsr2"), name=f"seed-mtsr2-{angle_deg:g}-deg")
        method = bench.network(training, _by_angle(bench, angle_deg), validation.thinned(ONE_IN))
        head: Row = {"network": "MTSR-2", "angle deg": angle_deg}
        rows.append(judged(head, method, {"test": turned}, alone_db=alone_db)[0])
    report.say(
        "The paper's networks, each trained from the STSR for as many steps and evaluated with its own angle; of the"
        " gain over the STSR a part is these steps. In the paper 10 degrees are best. The newest taps differ between"
        " angles by their pose error alone."
    )
    report.table(rows, "MTSR-2 by angle between the taps, test set.")


def _by_angle(bench: Workbench, angle_step_deg: float) -> PressSet:
    """Return the mixed data with two taps that are turned by another angle."""
    if angle_step_deg == ANGLE_STEP_DEG:
        return mixed(bench)
    schedule = f"turns:{angle_step_deg:g}"
    turned = {name: replace(world, taps=2, schedule=schedule, scale=SCALE) for name, world in SETS.items()}
    parts = [bench.presses(f"paper-{name}-{angle_step_deg:g}-deg", world, 2) for name, world in turned.items()]
    return join_presses(parts)


def taps(bench: Workbench, report: Report) -> None:
    """Compare one network with one to seven taps, and an STSR, on the same targets: Fig. 13."""
    data, test, validation = mixed(bench), {"test": bench.frozen("test")}, bench.frozen("validation")
    stsr, fused = (trained(bench, one, data, validation) for one in (from_base("stsr-alike", 1, 2000), FUSED))
    row, alone_db = judged({"network": "STSR", "taps given": 1}, stsr, test)
    rows = [row]
    for given in tracked(range(1, MAX_TAPS + 1), "taps", "run"):
        rows.append(judged({"network": "fusion", "taps given": given}, fused, test, given, alone_db)[0])
    report.say("Both networks are trained on from one of a single tap for as long. `table3` has the paper's by taps.")
    report.table(rows, "By number of taps, test set.")


TEST_SEED: Final = 999_000_000
TEST_FIGURES: Final = 24
GIVEN: Final = (1, 4)
_EVERY: Final = Training("unseen-all", "fusion-mtsr4", Recipe(steps=16_000, given=given_taps(max(GIVEN)), bf16=True))


def unseen(bench: Workbench, report: Report) -> None:
    """Compare networks trained on surfaces alone and with random figures, on others.

    Three of the 18 surfaces are held out; tested glyphs and polygons are of another seed than the trained ones. All
    networks are identical.

    Source: Wu and Liu 2024, Fig. 16 and Sec. VI-C.
    """
    numbers = range(TEST_SEED, TEST_SEED + TEST_FIGURES)
    glyphs, polygons = ([f"{kind}:{number}" for number in numbers] for kind in ("glyph", "polygon"))
    surfaces = {"15 seen": KNOWN, "3 held out": HELD_OUT, "glyphs": glyphs, "polygons": polygons}
    tests = {name: bench.frozen("test", names) for name, names in surfaces.items()}
    validation = bench.frozen("validation")
    networks = {
        name: bench.network(training, data, validation if training is _EVERY else bench.frozen("validation", KNOWN))
        for name, (training, data) in training_sets(bench).items()
    }
    rows: list[Row] = []
    alone_db: dict[tuple[str, int], NDArray[np.float64]] = {}
    for name, method in tracked(networks.items(), "judging", "network"):
        for (tested, frozen), given in product(tests.items(), GIVEN):
            head: Row = {"trained on": name, "tested on": tested, "taps": given}
            row, found_db = judged(head, method, {"test": frozen}, given)
            over_db = found_db - alone_db.setdefault((tested, given), found_db)  # of the first
            rows.append(row | {"over the 15 dB": with_interval(over_db, frozen.tap, sign="+")})
    report.say(
        f"Held out: {', '.join(HELD_OUT)}. Figures are random glyphs and polygons, {SETS['figures'].count} to train on "
        f"and {TEST_FIGURES} of each kind, of another seed, to test. All tests are made at the test position, though "
        f"pose errors bring some training taps near it. Every network is `{_EVERY.network}` at x{_EVERY.scale}, "
        f"{_EVERY.recipe.steps} steps of {_EVERY.recipe.batch} windows; contact levels "
        "are set on the 15 surfaces at the validation position (on the 18 for `18 + figures`)."
    )
    report.table(rows, "`over the 15` is over the network trained on the 15 surfaces alone, frame by frame.")


def training_sets(bench: Workbench) -> dict[str, tuple[Training, PressSet]]:
    """Return the trainings with their presses, by name; all but the last are without the held-out surfaces."""
    seen, held_out, figures = (presses(bench, name).at_scale(_EVERY.scale) for name in SETS)
    return {
        "15": (replace(_EVERY, name="unseen-alone"), seen),
        "15 + figures": (replace(_EVERY, name="unseen-both"), join_presses([seen, figures])),
        "18 + figures": (_EVERY, join_presses([seen, held_out, figures])),
    }
