"""Compare models with their networks in a table; the exit code is 1 where a bound is broken.

python -m export.verify edge/models/*.onnx

Every graph is run on the frozen test set and on extreme windows, and compared with its torch network, which is restored
from the float32 graph.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from edge.bench.subjects import FROZEN_FILE
from edge.errors import ModelError
from edge.evaluation.metrics import psnr_db
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from edge.inference.bundled import INT8_SUFFIX
from edge.inference.contract import Contract
from export.graph import ExportError, ParityError
from export.parity import (
    EXTREME_TOLERANCE,
    TOLERANCE,
    GraphRun,
    accepted,
    differences,
    extreme_windows,
    read_windows,
    run_network,
)
from export.to_onnx import MOST_LOSS_DB
from firmware_bridge.pad_geometry import AXES
from train.errors import CheckpointError, ended_by_errors
from train.learning.checkpoint import network_of, origin_of
from train.networks.blocks import PatternNet
from train.report import Report, Row, markdown

# Largest relative difference from the network, in any pixel: on readings, and on windows beyond any touch, where int8
# saturates: it is off by the value itself, and the runtime believes no pattern there.
BOUNDS: Final = {"float32": (TOLERANCE, EXTREME_TOLERANCE), "int8": (0.25, 1.05)}


class Parity(NamedTuple):
    """Comparison of one graph on some windows: the differences by output, and which bound is broken, or ""."""

    model: str
    windows: str
    differences: dict[str, float]
    psnr_change_db: float | None
    broken: str


def verify(path: Path, frozen: FrozenSet) -> Iterator[Parity]:
    """Compare one model with its network on the test set, on its newest taps alone, and on extreme windows.

    A model of another scale than the test set's is compared with its network, but not evaluated. ModelError if it is no
    model, ExportError if its network is not available.
    """
    model = _load(path)
    try:
        contract = Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})
        net = _network(path, model, contract)
    except (ModelError, ExportError, CheckpointError) as error:
        raise type(error)(f"{path}: {error}") from error
    groups: dict[str, NDArray[np.float32]] = {"test set": read_windows(frozen, contract, None)}
    if contract.takes_poses:
        groups["one tap"] = groups["test set"][:, : len(AXES)]
    groups["extreme"] = np.concatenate([*extreme_windows(contract).values()])
    truth = frozen.patterns() if contract.scale == frozen.scale else None
    run = GraphRun(model)
    for name, windows in groups.items():
        try:
            true = truth if name == "test set" else None
            yield Parity(path.stem, name, *judged(name, contract, run_network(net, windows), run(windows), true))
        except ParityError as error:
            yield Parity(path.stem, name, {}, None, str(error))


def judged(
    windows: str,
    contract: Contract,
    expected: list[NDArray[np.float32]],
    given: list[NDArray[np.float32]],
    truth: NDArray[np.float32] | None,
) -> tuple[dict[str, float], float | None, str]:
    """Return the differences, the graph's PSNR over the network's if there is a truth, and the broken bound or ""."""
    full_scale = contract.output_full_scale
    found = differences(list(contract.output_shapes), expected, given, full_scale)
    change_db = None
    if truth is not None:
        change_db = float((psnr_db(given[0], truth, full_scale) - psnr_db(expected[0], truth, full_scale)).mean())
    bound = BOUNDS[contract.arithmetic][windows == "extreme"]
    broken, largest = "", max(found, key=lambda output: found[output] / accepted(output, bound))
    if not found[largest] <= (most := accepted(largest, bound)):
        broken = f"{largest} differs by {found[largest]:.1e}, more than {most:g}"
    elif change_db is not None and not change_db >= -MOST_LOSS_DB:
        broken = f"{-change_db:.3f} dB lost, more than {MOST_LOSS_DB}"
    if len(given) > 1 and not (given[1] > 0).all():
        broken = "a deviation is not above zero"
    return found, change_db, broken


def _network(path: Path, model: onnx.ModelProto, contract: Contract) -> PatternNet:
    """Return a model's network, whose training hash must match."""
    source = path.with_stem(path.stem.removesuffix(INT8_SUFFIX))
    if not source.exists():
        raise ExportError(f"the float32 model {source.name} is not in the folder of its int8 model: put it there")
    graph = _load(source)
    net = network_of(graph)
    trained_alike = origin_of(graph)["training_sha256"] == origin_of(model)["training_sha256"]
    if not trained_alike or (net.taps, net.scale) != (contract.taps, contract.scale):
        raise ExportError(f"{source} is of another training than the model: export the model again from it")
    return net


def _load(path: Path) -> onnx.ModelProto:
    try:
        return onnx.load_from_string(path.read_bytes())
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from error
    except DecodeError as error:
        raise ModelError(f"{path}: not an ONNX model") from error


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m export.verify", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("models", type=Path, nargs="+", help="NAME.onnx or NAME-int8.onnx")
    parser.add_argument("--out", type=Path, metavar="FILE.md", help="write the table as a report, too")
    options = parser.parse_args(arguments)
    with ended_by_errors("verify"):
        out: Path | None = options.out
        report = None if out is None else Report(out.stem, out.parent, __file__, [*options.models, FROZEN_FILE])
        frozen = load_frozen_set(FROZEN_FILE)
        rows = [row for path in options.models for row in verify(path, frozen)]
        table: list[Row] = [
            {
                "model": row.model,
                "windows": row.windows,
                "difference": " ".join(f"{relative:.1e}" for relative in row.differences.values()) or "-",
                "PSNR change dB": "-" if row.psnr_change_db is None else f"{row.psnr_change_db:+.4f}",
                "bound": row.broken or "holds",
            }
            for row in rows
        ]
        sys.stdout.write(markdown(table) + "\n")
        if report is not None:
            report.table(table, f"With torch {torch.__version__}; of pattern, deviation and traction the largest.")
            report.write()
    broken = sum(bool(row.broken) for row in rows)
    if broken:
        sys.exit(f"verify: {broken} of {len(rows)} comparisons break a bound")


if __name__ == "__main__":
    main()
