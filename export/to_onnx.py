"""Checkpoints to ONNX: one file a model, fixed shapes, the contract inside, parity checked before it is written.

python -m export.to_onnx checkpoints/stsr.pt checkpoints/mtsr4.pt --out edge/models
python -m export.to_onnx checkpoints/stsr.pt --int8 data/seen.npz data/figures.npz --out edge/models

Where integers cost more than they may on the validation set, the network is trained on for them, on the same taps.
"""

import argparse
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import torch

from edge.bundle import BUNDLE_DIR
from edge.contract import CONTRACT_VERSION, TAP_ORDER, Contract
from edge.errors import EdgeError
from edge.frozen import FrozenSet, load_frozen_set
from edge.judge import judge_model, mean_error
from edge.session import ModelSession
from export.errors import ExportError
from export.fine_tune import FineTuning, quantised_well
from export.graph import outputs, to_model
from export.int8 import calibration_windows, convolutions, quantised
from export.parity import check_parity, extreme_windows, read_windows
from export.reference import INT8_SUFFIX, origin
from export.rounding import folded
from firmware_bridge.geometry import USPA44, SensorGeometry
from train.batches import COUNTS_PER_UNIT
from train.calibration import half_width_mm
from train.dataset import Sequences, join, load_sequences
from train.errors import CheckpointError, TrainError
from train.freeze import held_out
from train.networks.blocks import PatternNet
from train.poses import ANGLE_STEP_DEG
from train.training import load_network

OUTPUT_UNIT: Final = "mm"
MOST_LOSS_DB: Final = 0.1
"""What integers may cost on the frozen test set."""
FINE_TUNE_STEPS: Final = 500
_COSTLY: Final = f"more than {MOST_LOSS_DB} dB"
MOST_COVERAGE_CHANGE: Final = 0.02
"""What integers may change the share of pixels by that the 90 % interval holds."""
_UNSURE: Final = f"an interval changed by more than {MOST_COVERAGE_CHANGE:.0%}"


def contract_of(
    net: PatternNet, report: dict[str, Any], frozen: FrozenSet, geometry: SensorGeometry, batch: int = 1
) -> Contract:
    """What a network's graph keeps, its error not yet known.

    Raises:
        CheckpointError: the report beside the weights lacks a key; it is named.
    """
    example = torch.zeros(1, 3 * net.taps, geometry.rows, geometry.cols)
    deviations = len(outputs(net, example)) == 2
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
        sensor=geometry.name,
        rows=geometry.rows,
        cols=geometry.cols,
        pitch_mm=geometry.pitch_mm,
        arithmetic="float32",
        interval_factor=float(half_width_mm(1.0)) if deviations else None,
        training_sha256=training_sha256,
        test_set_sha256=frozen.sha256(),
        test_error={},
    )


def export(
    checkpoint: Path,
    folder: Path,
    frozen: FrozenSet,
    geometry: SensorGeometry = USPA44,
    batch: int = 1,
    calibration: Sequences | None = None,
    *,
    every: bool = False,
    tuning: FineTuning | None = None,
) -> str:
    """Write NAME.onnx for NAME.pt, or NAME-int8.onnx, and say in a line what it is.

    Parity is checked in float32, also of what is quantised afterwards. The error is that of a batch of one, in the
    runtime's own session; a network of another scale than the frozen set's is not judged.

    Args:
        checkpoint: NAME.pt of train.fit.
        folder: where the model goes.
        frozen: the test set.
        geometry: of the sensor.
        batch: windows in one run.
        calibration: training taps of which integers take their ranges; float32 without.
        every: all convolutions in integers, not only those that are worth it.
        tuning: how a network is trained on where integers cost more than MOST_LOSS_DB, or None for never.

    Raises:
        CheckpointError: the checkpoint cannot be used.
        ParityError: the graph does not compute what the network computes; nothing is written.
        ModelError: the graph does not keep its contract; nothing is written.
        ExportError: nothing of the graph can be done in integers, or the batch is not positive.
    """
    net, report = load_network(checkpoint)
    net = folded(net)
    contract = contract_of(net, report, frozen, geometry, batch)
    windows = np.concatenate([read_windows(frozen, contract), *extreme_windows(contract).values()])
    model = to_model(net, geometry, batch)
    difference = check_parity(net, model, windows, contract.output_full_scale)
    name, facts = checkpoint.stem, [f"x{contract.scale}"]
    single = model if batch == 1 else to_model(net, geometry)
    session = _session(_bytes(single, replace(contract, batch=1), report), name)
    judged = contract.scale == frozen.scale
    in_float = mean_error(judge_model(session, frozen)) if judged else {}
    said = ""
    if calibration is not None:
        seen = calibration_windows(calibration, contract)
        name, contract = name + INT8_SUFFIX, replace(contract, arithmetic="int8")
        well = quantised_well(net, geometry, seen, calibration, tuning, MOST_LOSS_DB, every=every)
        if tuning is not None and well.trained_on:
            difference = check_parity(well.net, well.model, windows, contract.output_full_scale)
            mixed_sha256 = tuning.sha256(contract.training_sha256, calibration.sha256(), every=every)
            contract = replace(contract, training_sha256=mixed_sha256)
        said, single = well.said, well.integers
        model = single if batch == 1 else quantised(to_model(well.net, geometry, batch), seen, every=every)
        session = _session(_bytes(single, replace(contract, batch=1), report), name)
    if judged:
        for given in range(1, net.taps + 1):
            contract.test_error[str(given)] = mean_error(judge_model(session, frozen, given))
        error = contract.test_error[str(net.taps)]
        facts.append(f"{error['psnr_db']:.2f} dB, SSIM {error['ssim']:.3f}")
        if "coverage_90" in error:
            facts.append(f"interval covers {error['coverage_90']:.1%}")
    else:
        facts.append(f"not judged, the test set is of x{frozen.scale}")
    facts.append(f"parity {difference:.1e}")
    if calibration is not None:
        integer, convs = convolutions(model)
        facts.append(f"{integer} of {convs} convolutions in integers")
        if in_float:
            facts += _cost(in_float, contract.test_error[str(net.taps)])
    facts += [said] * bool(said)
    content = _bytes(model, contract, report)
    (folder / f"{name}.onnx").write_bytes(content)
    return f"{name}.onnx: {len(content) / 1e6:.2f} MB, {', '.join(facts)}"


def _cost(in_float: Mapping[str, float], in_integers: Mapping[str, float]) -> list[str]:
    """What integers cost, and what of that is too much."""
    lost_db = in_float["psnr_db"] - in_integers["psnr_db"]
    facts = [f"{lost_db:.3f} dB lost to them"]
    if lost_db > MOST_LOSS_DB:
        facts.append(_COSTLY)
    if "coverage_90" in in_float and abs(in_integers["coverage_90"] - in_float["coverage_90"]) > MOST_COVERAGE_CHANGE:
        facts.append(_UNSURE)
    return facts


def _session(content: bytes, name: str) -> ModelSession:
    with tempfile.TemporaryDirectory() as drafts:
        draft = Path(drafts) / f"{name}.onnx"
        draft.write_bytes(content)
        return ModelSession(draft)


def _bytes(model: onnx.ModelProto, contract: Contract, report: Mapping[str, Any]) -> bytes:
    """The file's content, the same for the same model and contract."""
    del model.metadata_props[:]
    for key, value in (contract.to_metadata() | origin(report)).items():
        model.metadata_props.add(key=key, value=value)
    return model.SerializeToString(deterministic=True)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m export.to_onnx", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkpoints", type=Path, nargs="+", help="NAME.pt of train.fit")
    parser.add_argument("--out", type=Path, default=Path(), help="folder for NAME.onnx (default: here)")
    parser.add_argument("--batch", type=int, default=1, help="windows in one run (default: 1, as the runtime wants it)")
    parser.add_argument("--int8", type=Path, nargs="+", metavar="DATA", help="NAME-int8.onnx, ranges of these taps")
    parser.add_argument(
        "--all-integers", action="store_true", help="with --int8: all convolutions, not the large alone"
    )
    parser.add_argument(
        "--fine-tune-steps",
        type=int,
        default=FINE_TUNE_STEPS,
        metavar="N",
        help=f"with --int8: train on where they cost over {MOST_LOSS_DB} dB (default: {FINE_TUNE_STEPS}; 0: never)",
    )
    options = parser.parse_args(arguments)
    if options.fine_tune_steps < 0:
        parser.error(f"--fine-tune-steps is {options.fine_tune_steps}, expected 0 or more")
    if options.int8 is None and options.all_integers:
        parser.error("--all-integers needs --int8")
    if options.int8 is None and options.fine_tune_steps != FINE_TUNE_STEPS:
        parser.error("--fine-tune-steps needs --int8")
    lines: list[str] = []
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
        taps = None if options.int8 is None else join([load_sequences(path) for path in options.int8])
        tuned = taps is not None and options.fine_tune_steps > 0
        tuning = FineTuning(options.fine_tune_steps, held_out("validation")) if tuned else None
        for checkpoint in options.checkpoints:
            line = export(
                checkpoint,
                options.out,
                frozen,
                batch=options.batch,
                calibration=taps,
                every=options.all_integers,
                tuning=tuning,
            )
            sys.stdout.write(line + "\n")
            lines.append(line)
    except (ExportError, TrainError, EdgeError) as error:
        sys.exit(f"export: {error}")
    except OSError as error:
        sys.exit(f"export: {error.filename}: {error.strerror}")
    costly = {line.partition(":")[0]: [cost for cost in (_COSTLY, _UNSURE) if cost in line] for line in lines}
    told = [f"{name} ({' and '.join(costs)})" for name, costs in costly.items() if costs]
    if told:
        sys.exit(f"export: integers cost too much in {', '.join(told)}: use the float32 model, or fine-tune for longer")


if __name__ == "__main__":
    main()
