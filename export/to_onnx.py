"""Checkpoints to ONNX: one file a model, fixed shapes, the contract inside, parity checked before it is written.

python -m export.to_onnx checkpoints/stsr.pt checkpoints/mtsr4.pt --out edge/models
"""

import argparse
import logging
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from edge.bundle import BUNDLE_DIR
from edge.contract import CONTRACT_VERSION, DEVIATION_NAME, INPUT_NAME, OUTPUT_NAME, TAP_ORDER, Contract
from edge.errors import EdgeError
from edge.frozen import FrozenSet, load_frozen_set
from edge.judge import judge_model, mean_error
from edge.session import ModelSession
from export.errors import ExportError, ParityError
from firmware_bridge.geometry import USPA44, SensorGeometry
from train.batches import COUNTS_PER_UNIT
from train.calibration import half_width_mm
from train.errors import CheckpointError, TrainError
from train.networks.blocks import PatternNet
from train.poses import ANGLE_STEP_DEG
from train.training import load_network

OPSET: Final = 18
OUTPUT_UNIT: Final = "mm"
PARITY_WINDOWS: Final = 100
"""Readings of the frozen set that parity is checked on, about; they have no scale, so they serve networks of any."""
PARITY_TOLERANCE: Final = 1e-5
"""Largest difference between torch and onnxruntime, as a share of full scale, for deviations of the map's largest.

Both compute in float32 and add in another order. Measured from x4 to x20: compact networks 6e-7, seed-size ones 2e-6.
"""


def to_model(net: PatternNet, geometry: SensorGeometry) -> onnx.ModelProto:
    """The network as an ONNX graph of batch 1, checked, without a contract yet."""
    example = torch.zeros(1, 3 * net.taps, geometry.rows, geometry.cols)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that torchvision is not there
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch's own, about torch's own
        program = torch.onnx.export(
            net,
            (example,),
            dynamo=True,
            opset_version=OPSET,
            input_names=[INPUT_NAME],
            output_names=[OUTPUT_NAME, DEVIATION_NAME][: len(_outputs(net, example))],
            verbose=False,
        )
    if program is None:
        raise ExportError("torch.onnx.export gave no program")
    model = program.model_proto
    graph = model.graph
    # Where a layer was traced from is the exporter's affair, and holds paths of the machine it ran on.
    del model.metadata_props[:]
    for node in graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del value.metadata_props[:]
    onnx.checker.check_model(model, full_check=True)
    return model


def _outputs(net: nn.Module, window: Tensor) -> tuple[Tensor, ...]:
    """The pattern, and its deviation where the network gives one."""
    with torch.inference_mode():
        given = net(window)
    return given if isinstance(given, tuple) else (given,)


def check_parity(net: nn.Module, session: ModelSession, windows: NDArray[np.float32]) -> float:
    """Largest difference between torch and the runtime, as a share of full scale, for deviations of the map's largest.

    Args:
        net: in evaluation mode.
        session: of its graph.
        windows: (n, K, 3, rows, cols) in network units.

    Raises:
        ParityError: it is larger than PARITY_TOLERANCE, or a value is not finite.
        ModelError: the graph gives what no model may give.
    """
    largest = 0.0
    for window in windows:
        expected = _outputs(net, torch.from_numpy(window.reshape(session.contract.window_shape)))
        got = (session.run(window), session.deviation)
        units = (session.contract.output_full_scale, 0.0)
        for name, true, found, unit in zip(session.contract.output_shapes, expected, got, units, strict=False):
            true_map = true[0].numpy()
            difference = float(np.abs(found - true_map).max() / max(unit, np.abs(true_map).max()))
            if not difference <= PARITY_TOLERANCE:
                raise ParityError(
                    f"onnxruntime and torch differ by {difference:.2e} in the {name}, expected at most"
                    f" {PARITY_TOLERANCE:.0e}"
                )
            largest = max(largest, difference)
    return largest


def parity_windows(frozen: FrozenSet, contract: Contract) -> NDArray[np.float32]:
    """Windows (n, K, 3, rows, cols) in network units: readings of all forces, and inputs that no test set holds.

    These are nothing, denormals, one hot taxel, full range and a thousandfold of it.
    """
    step = max(1, len(frozen) // PARITY_WINDOWS) | 1  # odd, so that no frame of a tap is always the one taken
    read = [contract.scale_window(window) for window in frozen.windows(contract.taps)[::step]]
    one_hot = np.zeros_like(read[0])
    one_hot[0, 2, 0, 0] = 10.0
    full = np.full_like(one_hot, 10.0)
    return np.stack([*read, np.zeros_like(full), np.full_like(full, 1e-40), one_hot, full, full * 1e3])


def contract_of(net: PatternNet, report: dict[str, Any], frozen: FrozenSet, geometry: SensorGeometry) -> Contract:
    """What a network's graph keeps, its error not yet known.

    Raises:
        CheckpointError: the report beside the weights lacks a key; it is named.
    """
    example = torch.zeros(1, 3 * net.taps, geometry.rows, geometry.cols)
    deviations = len(_outputs(net, example)) == 2
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
        output_unit=OUTPUT_UNIT,
        output_full_scale=frozen.full_scale_mm,
        contact_level=contact_level,
        sensor=geometry.name,
        rows=geometry.rows,
        cols=geometry.cols,
        pitch_mm=geometry.pitch_mm,
        interval_factor=float(half_width_mm(1.0)) if deviations else None,
        training_sha256=training_sha256,
        test_set_sha256=frozen.sha256(),
        test_error={},
    )


def export(checkpoint: Path, folder: Path, frozen: FrozenSet, geometry: SensorGeometry = USPA44) -> str:
    """Write NAME.onnx for NAME.pt, and say in a line what it is.

    Parity and error are those of the runtime's own session. A network of another scale than the frozen set's is not
    judged.

    Raises:
        CheckpointError: the checkpoint cannot be used.
        ParityError: the graph does not compute what the network computes; nothing is written.
        ModelError: the graph does not keep its contract; nothing is written.
    """
    net, report = load_network(checkpoint)
    contract = contract_of(net, report, frozen, geometry)
    model = to_model(net, geometry)
    name = f"{checkpoint.stem}.onnx"
    with tempfile.TemporaryDirectory() as drafts:
        draft = Path(drafts) / name
        draft.write_bytes(_bytes(model, contract))
        session = ModelSession(draft)
    difference = check_parity(net, session, parity_windows(frozen, contract))
    judged = f"not judged, the test set is of x{frozen.scale}"
    if contract.scale == frozen.scale:
        for given in range(1, net.taps + 1):
            contract.test_error[str(given)] = mean_error(judge_model(session, frozen, given))
        error = contract.test_error[str(net.taps)]
        judged = f"{error['psnr_db']:.2f} dB, SSIM {error['ssim']:.3f}"
        if "coverage_90" in error:
            judged += f", interval covers {error['coverage_90']:.1%}"
    content = _bytes(model, contract)
    (folder / name).write_bytes(content)
    return f"{name}: {len(content) / 1e6:.2f} MB, x{contract.scale}, {judged}, parity {difference:.1e}"


def _bytes(model: onnx.ModelProto, contract: Contract) -> bytes:
    """The file's content, the same for the same model and contract."""
    del model.metadata_props[:]
    for key, value in contract.to_metadata().items():
        model.metadata_props.add(key=key, value=value)
    return model.SerializeToString(deterministic=True)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m export.to_onnx", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkpoints", type=Path, nargs="+", help="NAME.pt of train.fit")
    parser.add_argument("--out", type=Path, default=Path(), help="folder for NAME.onnx (default: here)")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
        for checkpoint in options.checkpoints:
            sys.stdout.write(export(checkpoint, options.out, frozen) + "\n")
    except (ExportError, TrainError, EdgeError) as error:
        sys.exit(f"export: {error}")


if __name__ == "__main__":
    main()
