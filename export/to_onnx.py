"""Checkpoints to ONNX: one file a model, fixed shapes, the contract inside, parity checked before it is written.

python -m export.to_onnx checkpoints/stsr.pt checkpoints/mtsr.pt --out edge/models
python -m export.to_onnx checkpoints/stsr.pt --int8 data/gripped.npz --out edge/models
python -m export.to_onnx checkpoints/stsr.pt --validation data/validation.npz --intervals data/gripped.npz

With validation presses, deviations are corrected by region, so that their intervals hold; with --intervals, by window.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch

from edge.errors import EdgeError
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from edge.inference.bundled import BUNDLE_DIR, INT8_SUFFIX
from edge.inference.contract import ANY_BATCH, CONTRACT_VERSION, TAP_ORDER, Contract
from edge.inference.trust import Trust
from edge.terminal.progress_bar import tracked
from export.errors import ExportError
from export.graphs.graph import known_width, outputs, to_model
from export.graphs.intervals import IntervalData
from export.graphs.parity import check_parity
from export.graphs.writing import Writer
from export.quantisation.int8 import calibration_batch, convolutions, quantised
from firmware_bridge.pad_geometry import pad_of
from train.data.frozen_presses import freeze_presses
from train.data.generation_config import SEED
from train.data.paper_taps import paper_taps
from train.data.press_batches import COUNTS_PER_UNIT
from train.data.presses import PressSet, join_presses, load_presses
from train.errors import CheckpointError, TrainError
from train.learning.checkpoint import load_network
from train.learning.expected_error_table import confidence_sets
from train.learning.interval_fit import half_width_mm
from train.networks.blocks import PatternNet
from train.networks.symmetric import write_out
from train.physics.pad_draws import input_scale
from train.surfaces.poses import ANGLE_STEP_DEG, REACH_MM
from train.trust import load_trust

OUTPUT_UNIT: Final = "mm"
MOST_LOSS_DB: Final = 0.1
"""Largest accepted loss by int8 on the frozen test set, in [dB]."""
_COSTLY: Final = f"more than {MOST_LOSS_DB} dB"
MOST_COVERAGE_CHANGE: Final = 0.02
"""Largest accepted change of the 90 % interval's coverage by int8."""
_UNSURE: Final = f"an interval changed by more than {MOST_COVERAGE_CHANGE:.0%}"


def contract_of(net: PatternNet, report: dict[str, Any], frozen: FrozenSet, batch: int | str) -> Contract:
    """Return the contract of a network's graph for the pad of the test set, with its error still empty.

    Raises:
        CheckpointError: the report of the weights lacks a key; the error names it.
    """
    pad = pad_of(*frozen.newest.shape[-2:])
    example = torch.zeros(1, 3 * net.taps, pad.rows, pad.cols)
    given = outputs(net, example)
    known = known_width(net)
    try:
        contact_level, training_sha256 = report["contact_level"], report["training_sha256"]
    except KeyError as error:
        raise CheckpointError(f"the checkpoint's .json has no {error}: train it with this release") from error
    return Contract(
        version=CONTRACT_VERSION,
        batch=batch,
        taps=net.taps,
        scale=net.scale,
        tap_order=TAP_ORDER,
        angle_step_deg=ANGLE_STEP_DEG,
        counts_per_unit=COUNTS_PER_UNIT,
        output_unit=OUTPUT_UNIT,
        output_full_scale=frozen.full_scale_mm,
        contact_level=contact_level,
        sensor=pad.name,
        rows=pad.rows,
        cols=pad.cols,
        pitch_mm=pad.pitch_mm,
        arithmetic="float32",
        interval_factor=float(half_width_mm(1.0)) if len(given) > 1 else None,
        confidence={},
        training_sha256=training_sha256,
        test_set_sha256=frozen.sha256(),
        test_error={},
        pad_inputs=tuple(input_scale()) if known else (),
        takes_gains=bool(known),
        traction_scale=given[2].shape[-1] // pad.cols if len(given) > 2 else None,
        takes_poses=net.takes_poses,
        reach_mm=REACH_MM if net.takes_poses else 0.0,
        unposed_taps=1 if net.takes_poses else net.taps,
    )


def export(
    checkpoint: Path,
    folder: Path,
    frozen: FrozenSet,
    *,
    batch: int | str = 1,
    calibration: PressSet | None = None,
    validation: Sequence[FrozenSet] = (),
    trust: Trust | None = None,
    intervals: IntervalData | None = None,
) -> str:
    """Write NAME.onnx for NAME.pt, or NAME-int8.onnx, and return a line that describes it.

    Parity is checked in float32, also for graphs that are then quantised.

    Args:
        checkpoint: NAME.pt of train.fit.
        folder: of the model.
        frozen: the test set, of the pad that the model is for.
        batch: windows in one run, or ANY_BATCH.
        calibration: training taps from which int8 ranges are measured; None for float32.
        validation: sets on which confidence is fitted; without them, the contract's confidence stays empty.
        trust: forward model and checks for the contract; None for none.
        intervals: presses by which the intervals are corrected; None to leave them as the checkpoint has them.
    """
    net, report = load_network(checkpoint)
    write_out(net)
    contract = contract_of(net, report, frozen, batch)
    pad = pad_of(contract.rows, contract.cols)
    level = contract.contact_level
    if intervals is not None and contract.interval_factor is not None:
        report = {**report, "options": {**report["options"], "intervals": True}}
    writer = Writer(folder, frozen, validation, report, trust)
    if intervals is not None:
        found = intervals.corrected(net, level)
        net, contract = found.net, replace(contract, interval_levels=found.interval_levels)
    traced = batch if batch == ANY_BATCH else 1  # a graph of any batch runs single windows as well
    single = to_model(net, traced, pad)
    parity = check_parity(net, single, frozen, contract)
    if calibration is None:
        model = single if batch == traced else to_model(net, batch, pad)
        if model is not single:
            check_parity(net, model, frozen, contract)
        return writer.write(checkpoint.stem, model, single, contract, [f"parity {parity:.1e}"])

    quantise = partial(quantised, seen=calibration_batch(calibration, contract))
    integers = quantise(single)
    if intervals is not None:
        found = intervals.conformed(net, integers)
        net, contract = found.net, replace(contract, interval_levels=found.interval_levels)
        integers = quantise(to_model(net, traced, pad))
    model = integers if batch == traced else quantise(to_model(net, batch, pad))
    integer, convs = convolutions(model)
    float_error = writer.error(single, contract)
    contract = replace(contract, arithmetic="int8", test_error={}, confidence={})
    cost = _cost(float_error, writer.error(integers, contract))
    facts = [f"{integer} of {convs} convolutions in int8", *cost]
    return writer.write(checkpoint.stem + INT8_SUFFIX, model, integers, contract, facts)


def _cost(in_float: Mapping[str, float], in_integers: Mapping[str, float]) -> list[str]:
    """Return the loss by int8 as text, with each exceeded limit; nothing without errors on the test set."""
    if not in_float:
        return []
    lost_db = in_float["psnr_db"] - in_integers["psnr_db"]
    facts = [f"{lost_db:.3f} dB lost to quantisation"]
    if lost_db > MOST_LOSS_DB:
        facts.append(_COSTLY)
    if "coverage_90" in in_float and abs(in_integers["coverage_90"] - in_float["coverage_90"]) > MOST_COVERAGE_CHANGE:
        facts.append(_UNSURE)
    return facts


def _batch(text: str) -> int | str:
    return text if text == ANY_BATCH else int(text)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m export.to_onnx", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("checkpoints", type=Path, nargs="+", help="NAME.pt, written by train.fit")
    add("--out", type=Path, default=Path(), help="folder for NAME.onnx (default: here)")
    add("--batch", type=_batch, default=1, help=f"windows in one run (default: 1), or '{ANY_BATCH}' number of them")
    help_of_intervals = "training presses on which intervals are fitted"
    add("--intervals", type=Path, nargs="+", metavar="DATA", help=help_of_intervals)
    add("--trust", type=Path, metavar="FILE", help="checks of train.trust, with --validation, or those of a model")
    add("--validation", type=Path, metavar="FILE", help="presses of the validation set, not used for training")
    help_of_int8 = "write NAME-int8.onnx too, with ranges from these taps"
    add("--int8", type=Path, nargs="+", metavar="DATA", help=help_of_int8)
    options = parser.parse_args(arguments)
    if options.intervals is not None and options.validation is None:
        parser.error("--intervals needs --validation")
    lines: list[str] = []
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
        taps = None if options.int8 is None else join_presses([*map(load_presses, options.int8)])
        presses = intervals = None
        if options.validation is None:
            validation = confidence_sets(paper_taps("validation"), frozen.scale)
        else:
            presses = load_presses(options.validation)
            validation = [freeze_presses(presses, SEED).as_frozen_set()]
            training = None if options.intervals is None else join_presses([*map(load_presses, options.intervals)])
            intervals = IntervalData(presses, training)
        trust = None if options.trust is None else load_trust(options.trust, presses)
        for checkpoint in tracked(options.checkpoints, "exporting", "model"):
            line = export(
                checkpoint,
                options.out,
                frozen,
                batch=options.batch,
                calibration=taps,
                validation=validation,
                trust=trust,
                intervals=intervals,
            )
            sys.stdout.write(line + "\n")
            lines.append(line)
    except (ExportError, TrainError, EdgeError) as error:
        sys.exit(f"export: {error}")
    except OSError as error:
        sys.exit(f"export: {error.filename}: {error.strerror}")
    costly = {line.partition(":")[0]: [cost for cost in (_COSTLY, _UNSURE) if cost in line] for line in lines}
    lossy = [f"{name} ({' and '.join(costs)})" for name, costs in costly.items() if costs]
    if lossy:
        sys.exit(f"export: quantisation costs too much in {', '.join(lossy)}: use the float32 model")


if __name__ == "__main__":
    main()
