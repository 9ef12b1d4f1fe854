"""Training of one network from its data to its checkpoint: NAME.pt (weights) with NAME.json (settings, figures).

A float32 ONNX graph is read like a checkpoint: it holds its network's weights, and its metadata say which one that is.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import numpy_helper

from edge.evaluation.metrics import contact_iou, psnr_db, ssim
from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import BUNDLE_DIR
from firmware_bridge.in_place import write_in_place
from train.data.press_batches import Batch, OneSensor, PosedBatches, PressBatches, network_input, with_own_taps
from train.data.presses import PressSet
from train.errors import CheckpointError, DatasetError
from train.learning.interval_fit import calibrate, interval_coverage
from train.learning.training_loop import DAMAGES, Recipe, best_device, reason, train, write_state
from train.networks.blocks import Objective, PatternNet, RelativeError
from train.networks.compact import CompactNet, HeteroscedasticError
from train.networks.named_networks import build, grown
from train.networks.published import SrganObjective, TactileSRGAN
from train.networks.symmetric import read_back

_CONTACT_LEVELS: Final = tuple(np.arange(0.3, 0.95, 0.05).round(2).tolist())
_GRAPH: Final = ".onnx"
ORIGIN_KEY: Final = "tactile.origin"


@dataclass(frozen=True, slots=True)
class Training:
    """Configuration that determines the weights of a network."""

    name: str  # of the checkpoint
    network: str  # a name of train.networks.named_networks
    recipe: Recipe
    scale: int = 10  # pattern pixels per taxel pitch
    start: str | None = None  # checkpoint whose weights it starts from, or NAME.onnx of a bundled model
    seed: int = 1  # of weights and draws
    options: dict[str, Any] = field(default_factory=dict)  # further arguments of the network's class
    sensor: OneSensor | None = None  # that it is for, None for any

    def sha256(self, data_sha256: str) -> str:
        """Return the hash of the configuration and the data, as written in the models' contract."""
        return hashlib.sha256(json.dumps([asdict(self), data_sha256], sort_keys=True).encode()).hexdigest()


def fit_network(
    training: Training, data: PressSet, validation: FrozenSet, folder: Path, taps: PressSet | None = None
) -> dict[str, Any]:
    """Train, calibrate, evaluate and write one network, unless that is done, and return the content of its NAME.json.

    `taps` of the one sensor that it is for are mixed in.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data_sha256, path = data.sha256(), folder / f"{training.name}.pt"
    if taps is not None:
        data_sha256 += taps.sha256()
    training_sha256 = training.sha256(data_sha256)
    start_path = None if training.start is None else _path_of(training.start, folder)
    start_sha256 = None if start_path is None else _file_sha256(start_path)
    made_of = {"training_sha256": training_sha256, "start_sha256": start_sha256}
    made_of["validation_sha256"] = validation.sha256()
    if path.exists() and path.with_suffix(".json").exists():
        _, report = load_network(path)
        if {name: report.get(name) for name in made_of} == made_of:
            return report
    torch.manual_seed(training.seed)
    net = (
        build(training.network, training.scale, **training.options)
        if start_path is None
        else grown(load_network(start_path)[0], training.network, training.scale, **training.options)
    )
    seed = int(hashlib.sha256(f"{training.seed} {training.name}".encode()).hexdigest()[:8], 16)
    recipe = training.recipe
    batches = batches_of(data, training.scale, recipe, seed, posed=net.takes_poses, sensor=training.sensor)
    if taps is not None and training.sensor is not None:
        batches = with_own_taps(batches, taps, training.sensor, seed)
    _check_validation(validation, data, net.taps)
    elapsed_s, course = train(
        net,
        _objective(net, seed),
        batches,
        recipe,
        (resume_path := folder / f"{training.name}.resume"),
        identity=f"{training_sha256} {start_sha256}",
    )
    net.cpu()
    report = {
        "name": training.name,
        "network": training.network,
        "scale": training.scale,
        "options": training.options,
        "taps": net.taps,
        "config": asdict(training),
        "data_sha256": data_sha256,
        **made_of,
        "steps": recipe.steps,
        "elapsed_s": round(elapsed_s, 1),
        **_evaluated(net, validation),
        "course": course,
    }
    # The report is written last, so that it never describes weights that do not exist.
    text = json.dumps(report, indent=1) + "\n"
    write_state(path, net.state_dict())
    write_in_place(path.with_suffix(".json"), lambda draft: draft.write_text(text), lambda draft: draft.read_text())
    resume_path.unlink(missing_ok=True)
    return report


def _check_validation(validation: FrozenSet, data: PressSet, taps: int) -> None:
    """Raise a DatasetError where a network cannot be evaluated on a set, before it is trained."""
    got, expected = (validation.scale, *validation.newest.shape[2:]), (data.scale, *data.counts.shape[3:])
    there = 1 + validation.earlier.shape[1]
    if got != expected or there < taps or not len(validation):
        raise DatasetError(
            f"the validation set has {len(validation)} sequences of {there} taps that are only turned, at x{got[0]} of "
            f"{got[1]} x {got[2]} taxels; expected some of {taps} taps, at x{expected[0]} of {expected[1]} x "
            f"{expected[2]} as the presses: make others with train.data.make_presses"
        )


def batches_of(
    data: PressSet, scale: int, recipe: Recipe, seed: int, *, posed: bool = False, sensor: OneSensor | None = None
) -> Callable[[int], Batch]:
    """Return batches for a recipe, of taps that were only turned unless they are posed; DatasetError without any."""
    if scale != data.scale:
        raise DatasetError(
            f"patterns at x{scale} asked for, these presses have them at x{data.scale}: make others at that scale"
        )
    if posed:
        return PosedBatches(data, recipe.given, recipe.batch, seed)
    turned = data.only_turned() if len(recipe.given) > 1 else data
    return PressBatches(turned, recipe.given, recipe.batch, seed, sensor=sensor)


def _path_of(start: str, folder: Path) -> Path:
    return BUNDLE_DIR / start if start.endswith(_GRAPH) else folder / f"{start}.pt"


def load_network(path: Path) -> tuple[PatternNet, dict[str, Any]]:
    """Load the network of NAME.pt and its report NAME.json, or that of a float32 NAME.onnx, or raise CheckpointError.

    The network is in evaluation mode.
    """
    try:
        if path.suffix == _GRAPH:
            model = onnx.load(path)
            return network_of(model), origin_of(model)
        report = json.loads(path.with_suffix(".json").read_text())
        net = build(report["network"], report["scale"], **report["options"])
        net.load_state_dict(torch.load(path, weights_only=True))
    except (*DAMAGES, DecodeError) as error:
        graph = path.suffix == _GRAPH
        what = "no model to start from" if graph else f"no checkpoint of train.fit with {path.stem}.json"
        raise CheckpointError(f"{path} is {what}: {reason(error)}") from error
    return net.eval(), report


def sensor_of(report: Mapping[str, Any]) -> OneSensor | None:
    """Return the one sensor that a network is for, from a checkpoint's report; None if it is for any."""
    stated = report.get("config", {}).get("sensor")
    return None if stated is None else OneSensor(**stated)


def origin(report: Mapping[str, Any]) -> dict[str, str]:
    """Return the metadata that identify a graph's network, from a checkpoint's report."""
    stated = {key: report[key] for key in ("network", "scale", "options", "training_sha256")}
    return {ORIGIN_KEY: json.dumps(stated, sort_keys=True)}


def origin_of(model: onnx.ModelProto) -> dict[str, Any]:
    """Return the metadata that identify a graph's network; CheckpointError if they are missing."""
    stated = {entry.key: entry.value for entry in model.metadata_props}.get(ORIGIN_KEY)
    if stated is None:
        raise CheckpointError(f"metadata key '{ORIGIN_KEY}' is missing: export the model again")
    return json.loads(stated)


def network_of(model: onnx.ModelProto) -> PatternNet:
    """Return the network of a float32 graph, in evaluation mode; CheckpointError if it lacks the network's weights."""
    made = origin_of(model)
    net = build(made["network"], made["scale"], **made["options"])
    held = {weight.name: torch.from_numpy(numpy_helper.to_array(weight).copy()) for weight in model.graph.initializer}
    lacking = read_back(net, held)
    if lacking:
        more = f" and {len(lacking) - 1} more weights" if len(lacking) > 1 else ""
        raise CheckpointError(f"the graph does not hold {lacking[0]}{more}: only its checkpoint does")
    return net.eval()


def infer(net: PatternNet, windows: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return patterns (n, H, W) in [mm] of windows (n, K, 3, rows, cols) in zeroed counts, and deviations or None."""
    device = next(net.parameters()).device
    rows: list[tuple[torch.Tensor, ...]] = []
    with torch.inference_mode():
        for part in torch.split(network_input(windows), 128):
            given = net(part.to(device))
            rows.append(given if isinstance(given, tuple) else (given,))
    outputs = [torch.cat(maps).float().cpu().numpy() for maps in zip(*rows, strict=True)]
    return outputs[0], outputs[1] if len(outputs) > 1 else None


def best_contact_level(patterns: NDArray[np.float32], touching: NDArray[np.bool_]) -> float:
    """Return the share of a pattern's maximum whose outline overlaps the true contact best."""
    overlap = [contact_iou(patterns, touching, level).mean() for level in _CONTACT_LEVELS]
    return _CONTACT_LEVELS[int(np.argmax(overlap))]


def _file_sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CheckpointError(f"{path}, to start from: {error.strerror or error}; train it first") from error


def _objective(net: PatternNet, seed: int) -> Objective:
    if isinstance(net, CompactNet):
        return HeteroscedasticError()
    return SrganObjective(best_device(), seed=seed) if isinstance(net, TactileSRGAN) else RelativeError()


def _evaluated(net: PatternNet, validation: FrozenSet) -> dict[str, float]:
    """Return figures on the validation set, and set the factor of the deviations."""
    patterns, deviations = infer(net, validation.windows(net.taps))
    truth = validation.patterns()
    figures = {
        "contact_level": best_contact_level(patterns, validation.touching()),
        "validation_psnr_db": float(psnr_db(patterns, truth, validation.full_scale_mm).mean()),
        "validation_ssim": float(ssim(patterns, truth, validation.full_scale_mm).mean()),
    }
    if deviations is not None and isinstance(net, CompactNet):
        factor = calibrate(truth, patterns, deviations)
        net.deviation_scale *= factor
        figures["validation_coverage"] = interval_coverage(truth, patterns, deviations * np.float32(factor))
    return figures
