"""Checkpoints to ONNX: one file a model, the contract inside, parity checked before it is written.

python -m export.to_onnx checkpoints/stsr.pt --validation data/validation.npz --out edge/models
python -m export.to_onnx checkpoints/stsr.pt --validation data/validation.npz --intervals data/gripped.npz
python -m export.to_onnx checkpoints/stsr.pt --validation data/validation.npz --int8 data/gripped.npz

Deviations are corrected by region on validation presses, so that their intervals hold; with --intervals, by window.
"""

import argparse
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet, judge_model, load_frozen_set, mean_error, windows_of
from edge.inference.bundled import BUNDLE_DIR, INT8_SUFFIX
from edge.inference.contract import CONTRACT_VERSION, TAP_ORDER, Contract
from edge.inference.intervals import doubt
from edge.inference.onnx_session import ModelSession, load_session
from edge.inference.trust_model import Trust
from edge.perception.runtime import Model
from edge.terminal.progress_bar import tracked
from export.graph import outputs, to_model
from export.int8 import calibration_batch, quantised
from export.parity import GraphRun, check_parity, run_network
from firmware_bridge.in_place import write_in_place
from firmware_bridge.pad_geometry import pad_of
from train.data.frozen_presses import freeze_presses
from train.data.press_batches import COUNTS_PER_UNIT, OneSensor
from train.data.presses import SEED, PressSet, join_presses, load_presses
from train.errors import CheckpointError, ended_by_errors
from train.learning.checkpoint import load_network, origin, sensor_of
from train.learning.interval_fit import Readings, conform, fit_correction, half_width_mm, readings_of_presses
from train.networks.blocks import PatternNet
from train.networks.compact import CompactNet
from train.networks.symmetric import write_out
from train.physics.pad_draws import input_scale
from train.physics.sensor_noise import Nuisances
from train.surfaces.poses import ANGLE_STEP_DEG, REACH_MM
from train.trust import load_trust

MOST_LOSS_DB: Final = 0.1  # largest accepted loss by int8 on the frozen test set, in [dB]
MOST_COVERAGE_CHANGE: Final = 0.02  # largest accepted change of the 90 % interval's coverage by int8


def contract_of(net: PatternNet, report: dict[str, Any], frozen: FrozenSet) -> Contract:
    """Return the contract of a network's graph for the pad of the test set, with its error still empty."""
    pad = pad_of(*frozen.newest.shape[-2:])
    example = torch.zeros(1, 3 * net.taps, pad.rows, pad.cols)
    given = outputs(net, example)
    try:
        contact_level, training_sha256 = report["contact_level"], report["training_sha256"]
    except KeyError as error:
        raise CheckpointError(f"the checkpoint's .json has no {error}: train it with this release") from error
    return Contract(
        version=CONTRACT_VERSION,
        taps=net.taps,
        scale=net.scale,
        tap_order=TAP_ORDER,
        angle_step_deg=ANGLE_STEP_DEG,
        counts_per_unit=COUNTS_PER_UNIT,
        output_unit="mm",
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
        pad_inputs=tuple(input_scale()) if net.known else (),
        takes_gains=bool(net.known),
        traction_scale=given[2].shape[-1] // pad.cols if len(given) > 2 else None,
        takes_poses=net.takes_poses,
        reach_mm=REACH_MM if net.takes_poses else 0.0,
        unposed_taps=1 if net.takes_poses else net.taps,
        made_for={name: [*ends] for name, ends in sensor.made_for.items()} if (sensor := sensor_of(report)) else {},
    )


def export(
    checkpoint: Path,
    folder: Path,
    frozen: FrozenSet,
    *,
    validation: PressSet | None = None,
    intervals: PressSet | None = None,
    calibration: PressSet | None = None,
    trust: Trust | None = None,
    steps: int = 2000,
) -> tuple[str, str]:
    """Write NAME.onnx for NAME.pt, or NAME-int8.onnx; return a line that describes it, and the limits it exceeds.

    One that exceeds a limit replaces no file. The model is for the pad of the test set `frozen`, which its errors are
    of. Intervals and confidence are set by `validation`; on the training presses `intervals`, if any, the correction of
    intervals is fitted, in so many steps. The ranges of int8 are measured on the training taps `calibration`.
    """
    net, report = load_network(checkpoint)
    write_out(net)
    contract, sensor = contract_of(net, report, frozen), sensor_of(report)
    pad, readings = pad_of(contract.rows, contract.cols), list[Readings]()
    if validation is not None and isinstance(net, CompactNet):
        if (validation.scale, *validation.counts.shape[3:]) != (net.scale, pad.rows, pad.cols):
            raise CheckpointError(f"{checkpoint} is at x{net.scale} of a {pad.name}, the validation presses are not")
        report = {**report, "options": {**report["options"], "intervals": True}}
        if intervals is None:
            net.add_intervals().contact_level.fill_(contract.contact_level)
        else:
            fit_correction(net, intervals, contract.contact_level, steps=steps)
        readings = readings_of_presses(validation, net.taps, sensor=sensor)
        levels = conform(net, lambda *given: run_network(net, *given), readings)
        contract = replace(contract, interval_levels=levels)
    name, model = checkpoint.stem, to_model(net, pad)
    facts = [f"parity {check_parity(net, model, frozen, contract):.1e}"]
    float_error: dict[str, float] = {}
    if calibration is not None:
        seen, in_float = calibration_batch(calibration, contract), model
        name, model = name + INT8_SUFFIX, quantised(in_float, seen)
        if readings and isinstance(net, CompactNet):
            contract = replace(contract, interval_levels=conform(net, GraphRun(model), readings))
            model = quantised(to_model(net, pad), seen)
        if contract.scale == frozen.scale:
            float_error = mean_error(judge_model(_session(in_float, contract), frozen))
        contract = replace(contract, arithmetic="int8")

    session = _session(model, contract)
    facts = [*judge_in_contract(session, frozen), *facts]
    contract = session.contract
    if validation is not None and readings:
        contract.confidence.update(fit_confidence(session, _as_test_set(validation, sensor)))
    lost, exceeded = cost(float_error, contract.test_error.get(str(contract.taps), {}))
    # The paper's networks, several of whose taps would be believed whatever they are, have neither.
    if trust is not None and contract.pad_inputs and contract.traction_scale:
        contract.trust.update(trust.to_json())
    content = _content(model, contract, origin(report))
    Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})  # checked as in the runtime
    path = folder / f"{name}.onnx"
    if exceeded and path.exists():
        exceeded += "; the file that was there stays"
    else:
        write_in_place(path, lambda draft: draft.write_bytes(content), load_session)
    line = f"{name}.onnx: {len(content) / 1e6:.2f} MB, {', '.join([*facts, *lost])}"
    return line, exceeded and f"{name}.onnx ({exceeded})"


def _as_test_set(presses: PressSet, sensor: OneSensor | None) -> FrozenSet:
    return freeze_presses(presses, SEED, Nuisances() if sensor is None else sensor.nuisances).as_frozen_set()


def _session(model: onnx.ModelProto, contract: Contract) -> ModelSession:
    with tempfile.TemporaryDirectory() as drafts:
        draft = Path(drafts) / "draft.onnx"
        draft.write_bytes(_content(model, contract))
        return ModelSession(draft)


def _content(model: onnx.ModelProto, contract: Contract, stated: Mapping[str, str] = MappingProxyType({})) -> bytes:
    """Return a file's content, the same for the same model, contract and further metadata."""
    del model.metadata_props[:]
    for key, value in {**contract.to_metadata(), **stated}.items():
        model.metadata_props.add(key=key, value=value)
    return model.SerializeToString(deterministic=True)


def cost(in_float: Mapping[str, float], in_integers: Mapping[str, float]) -> tuple[list[str], str]:
    """Return the loss by int8 as text, and which limits it exceeds; nothing of a float graph, or if none was judged."""
    if not in_float:
        return [], ""
    lost_db = in_float["psnr_db"] - in_integers["psnr_db"]
    exceeded = [f"more than {MOST_LOSS_DB} dB"] * (lost_db > MOST_LOSS_DB)
    if "coverage_90" in in_float and abs(in_integers["coverage_90"] - in_float["coverage_90"]) > MOST_COVERAGE_CHANGE:
        exceeded.append(f"an interval changed by more than {MOST_COVERAGE_CHANGE:.0%}")
    return [f"{lost_db:.3f} dB lost to quantisation"], " and ".join(exceeded)


BINS: Final = 10


def judge_in_contract(session: ModelSession, frozen: FrozenSet) -> list[str]:
    """Put errors on the test set into the contract of a model of its scale, and return them as text."""
    contract = session.contract
    parts = [f"x{contract.scale}"]
    if contract.scale == frozen.scale:
        for given in tracked(range(1, contract.taps + 1), "judging", "run"):
            contract.test_error[str(given)] = mean_error(judge_model(session, frozen, given))
        error = contract.test_error[str(contract.taps)]
        parts.append(f"{error['psnr_db']:.2f} dB, SSIM {error['ssim']:.3f}")
        if "coverage_90" in error:
            parts.append(f"interval covers {error['coverage_90']:.1%}")
    else:
        parts.append(f"not evaluated, the test set is of x{frozen.scale}")
    return parts


def fit_confidence(model: Model, frozen: FrozenSet) -> dict[str, dict[str, list[float]]]:
    """Fit the table of edge.inference.intervals for a model with deviations.

    Frames are sorted by their uncertainty into bins of equally many; a bin's gain is that of its frames together.
    """
    taps = model.contract.taps
    by_taps = [doubts_and_errors(model, given, frozen) for given in tracked(range(1, taps + 1), "confidence", "run")]
    rows = {str(given): _row(by_taps[given - 1 : given + 1]) for given in range(1, taps + 1)}
    return {given: row for given, row in rows.items() if row["doubt"]}  # empty if no pattern exceeds zero


def doubts_and_errors(model: Model, given: int, frozen: FrozenSet) -> NDArray[np.float64]:
    """Return uncertainty, RMS error and RMS of the pattern for every frame, (3, n), with the newest `given` taps."""
    rows, contract = [], model.contract
    for window, truth in zip(windows_of(frozen, contract, given), frozen.patterns(), strict=True):
        pattern, deviation = model.run(contract.scale_window(window)), model.deviation
        if deviation is None:
            raise ValueError(f"model '{model.name}' gives no deviation, so its error cannot be predicted")
        about, size = doubt(pattern, deviation)
        rows.append((about, float(np.sqrt(np.mean((pattern - truth) ** 2))), size))
    return np.array(rows).T


def _rising(bins: list[NDArray[np.intp]], about: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Join bins until each lies above the one before in its first four digits."""
    joined: list[NDArray[np.intp]] = []
    for part in bins:
        if joined and float(f"{about[part].mean():.4g}") <= float(f"{about[joined[-1]].mean():.4g}"):
            joined[-1] = np.concatenate([joined[-1], part])
        else:
            joined.append(part)
    return joined


def _row(by_taps: list[NDArray[np.float64]]) -> dict[str, list[float]]:
    about, error, size = by_taps[0]
    seen = size > 0  # a pattern of zeros has no uncertainty relative to its size
    about, share = about[seen], error[seen] / size[seen]
    bins = _rising([part for part in np.array_split(np.argsort(about), BINS) if part.size], about)
    row = {
        "doubt": [float(about[part].mean()) for part in bins],
        "error": [float(share[part].mean()) for part in bins],
        "gain": [],
    }
    if len(by_taps) == 2:
        later = by_taps[1][1][seen] / size[seen]
        row["gain"] = [float(1 - later[part].sum() / share[part].sum()) for part in bins]
    return {name: [float(f"{value:.4g}") for value in values] for name, values in row.items()}


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m export.to_onnx", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("checkpoints", type=Path, nargs="+", help="NAME.pt, written by train.fit")
    add("--out", type=Path, default=Path(), help="folder for NAME.onnx (default: here)")
    add("--intervals", type=Path, nargs="+", metavar="DATA", help="training presses on which intervals are fitted")
    add("--trust", type=Path, metavar="FILE", help="checks of train.trust, or those of a model")
    add("--validation", type=Path, required=True, metavar="FILE", help="presses of the validation set, not trained on")
    add("--test", type=Path, metavar="FILE", help="presses of a test set in place of the frozen one, for train.own")
    add("--int8", type=Path, nargs="+", metavar="DATA", help="write NAME-int8.onnx, with ranges from these taps")
    options = parser.parse_args(arguments)
    lossy: list[str] = []
    with ended_by_errors("export"):
        options.out.mkdir(parents=True, exist_ok=True)
        sensors = [sensor_of(load_network(path)[1]) for path in options.checkpoints]
        frozen, presses = load_frozen_set(BUNDLE_DIR / "frozen.npz"), load_presses(options.validation)
        test = None if options.test is None else load_presses(options.test)
        training = None if options.intervals is None else join_presses([*map(load_presses, options.intervals)])
        taps = None if options.int8 is None else join_presses([*map(load_presses, options.int8)])
        trust = None if options.trust is None else load_trust(options.trust, presses)
        for checkpoint, sensor in tracked([*zip(options.checkpoints, sensors, strict=True)], "exporting", "model"):
            line, exceeded = export(
                checkpoint,
                options.out,
                frozen if test is None else _as_test_set(test, sensor),
                validation=presses,
                intervals=training,
                calibration=taps,
                trust=trust,
            )
            sys.stdout.write(line + "\n")
            lossy += [exceeded] * bool(exceeded)
    if lossy:
        sys.exit(f"export: quantisation costs too much in {', '.join(lossy)}: use the float32 model")


if __name__ == "__main__":
    main()
