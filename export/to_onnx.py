"""Checkpoints to ONNX: one file a model, fixed shapes, the contract inside, parity checked before it is written.

python -m export.to_onnx checkpoints/stsr.pt checkpoints/mtsr4.pt --out edge/models
"""

import argparse
import json
import logging
import sys
import warnings
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray

from edge.bundle import BUNDLE_DIR
from edge.contract import CONTRACT_VERSION, INPUT_NAME, OUTPUT_NAME, TAP_ORDER, Contract
from edge.errors import EdgeError
from edge.frozen import FrozenSet, load_frozen_set
from edge.judge import infer_all, judge, mean_error
from export.errors import CheckpointError, ExportError, ParityError
from firmware_bridge.geometry import USPA44, SensorGeometry
from train.compact_net import CompactNet
from train.dataset import ANGLE_STEP_DEG

OPSET: Final = 18
OUTPUT_UNIT: Final = "mm"
PARITY_TOLERANCE: Final = 1e-5
"""Largest difference between torch and onnxruntime, as a share of full scale.

Both compute in float32 and add in another order: 2e-6 is measured on the frozen test set and on extreme inputs.
"""


def load_checkpoint(path: Path) -> tuple[CompactNet, dict[str, Any]]:
    """The network and the report beside it, NAME.pt and NAME.json.

    Raises:
        CheckpointError: a file is missing, or the weights do not fit the configuration.
    """
    try:
        report = json.loads(path.with_suffix(".json").read_text())
        config = report["config"]
        net = CompactNet(report["taps"], config["scale"], config["channels"], config["blocks"])
        net.load_state_dict(torch.load(path, weights_only=True))
    except (OSError, json.JSONDecodeError, KeyError, RuntimeError) as error:
        raise CheckpointError(f"{path} and {path.stem}.json are no checkpoint of train.fit: {error}") from error
    return net.eval(), report


def to_model(net: CompactNet, geometry: SensorGeometry) -> onnx.ModelProto:
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
            output_names=[OUTPUT_NAME],
            verbose=False,
        )
    if program is None:
        raise ExportError("torch.onnx.export gave no program")
    model = program.model_proto
    # Where a layer was traced from is the exporter's affair, and holds paths of the machine it ran on.
    del model.metadata_props[:]
    for node in model.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*model.graph.input, *model.graph.output, *model.graph.value_info, *model.graph.initializer):
        del value.metadata_props[:]
    onnx.checker.check_model(model, full_check=True)
    return model


def _run(session: onnxruntime.InferenceSession, window: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(session.run([OUTPUT_NAME], {INPUT_NAME: window})[0])


def check_parity(
    net: CompactNet, session: onnxruntime.InferenceSession, windows: NDArray[np.float32], unit: float
) -> float:
    """Largest difference between torch and onnxruntime as a share of `unit`, over windows (n, 3K, rows, cols).

    Raises:
        ParityError: it is larger than PARITY_TOLERANCE, or a value is not finite.
    """
    with torch.inference_mode():
        expected = net(torch.from_numpy(windows)).numpy()
    got = np.concatenate([_run(session, window[None]) for window in windows])
    if got.shape != expected.shape:
        raise ParityError(f"onnxruntime gives patterns of shape {got.shape}, torch {expected.shape}")
    scale = np.maximum(unit, np.abs(expected).max(axis=(1, 2), keepdims=True))
    difference = float((np.abs(got - expected) / scale).max())
    if not difference <= PARITY_TOLERANCE:
        raise ParityError(
            f"onnxruntime and torch differ by {difference:.2e} of full scale, expected at most {PARITY_TOLERANCE:.0e}"
        )
    return difference


def extreme_windows(taps: int, geometry: SensorGeometry) -> NDArray[np.float32]:
    """Inputs no test set holds, in network units: nothing, denormals, one hot taxel, full range and a thousandfold."""
    shape = (3 * taps, geometry.rows, geometry.cols)
    one_hot = np.zeros(shape, dtype=np.float32)
    one_hot[2, 0, 0] = 10.0
    full = np.full(shape, 10.0, dtype=np.float32)
    return np.stack(
        [np.zeros(shape, dtype=np.float32), np.full(shape, 1e-40, dtype=np.float32), one_hot, full, full * 1e3]
    )


def export(checkpoint: Path, folder: Path, frozen: FrozenSet, geometry: SensorGeometry = USPA44) -> str:
    """Write NAME.onnx for NAME.pt, and say in a line what it is.

    Raises:
        CheckpointError: the checkpoint cannot be used.
        ParityError: the graph does not compute what the network computes; nothing is written.
    """
    net, report = load_checkpoint(checkpoint)
    model = to_model(net, geometry)
    contract = Contract(
        version=CONTRACT_VERSION,
        taps=net.taps,
        scale=report["config"]["scale"],
        tap_order=TAP_ORDER,
        angle_step_deg=ANGLE_STEP_DEG,
        counts_per_unit=tuple(report["config"]["counts_per_unit"]),
        output_unit=OUTPUT_UNIT,
        output_full_scale=frozen.full_scale_mm,
        contact_level=report["contact_level"],
        sensor=geometry.name,
        rows=geometry.rows,
        cols=geometry.cols,
        pitch_mm=geometry.pitch_mm,
        training_sha256=report["training_sha256"],
        test_set_sha256=frozen.sha256(),
        test_error={},
    )
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])

    def run(window: NDArray[np.float32]) -> NDArray[np.float32]:
        return _run(session, window.reshape(contract.window_shape))[0]

    windows = np.stack([contract.scale_window(window) for window in frozen.windows(net.taps)])
    windows = windows.reshape(len(windows), *contract.window_shape[1:])
    inputs = np.concatenate([windows, extreme_windows(net.taps, geometry)])
    difference = check_parity(net, session, inputs, contract.output_full_scale)
    for given in range(1, net.taps + 1):
        patterns = infer_all(run, contract, frozen, given)
        contract.test_error[str(given)] = mean_error(judge(patterns, frozen, contract.contact_level))
    for key, value in contract.to_metadata().items():
        model.metadata_props.add(key=key, value=value)
    path = folder / f"{checkpoint.stem}.onnx"
    path.write_bytes(model.SerializeToString(deterministic=True))
    error = contract.test_error[str(net.taps)]
    return (
        f"{path.name}: {path.stat().st_size / 1e6:.2f} MB, {error['psnr_db']:.2f} dB, SSIM {error['ssim']:.3f},"
        f" parity {difference:.1e} of full scale"
    )


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
    except (ExportError, EdgeError) as error:
        sys.exit(f"export: {error}")


if __name__ == "__main__":
    main()
