"""A network of the registry with random weights as an ONNX file, for comparisons of run times.

python -m export.peer mtsr4 --out seed-mtsr4.onnx
edge-sr bench --against seed-mtsr4.onnx

It has no contract, so the runtime does not load it as a model, and its metadata states that it is untrained. From a
trained checkpoint `export.to_onnx` makes a model that `edge-sr bench --against` takes as well.
"""

import argparse
import sys
from pathlib import Path
from typing import Final

import torch

from edge.bench.contenders import WEIGHTS_KEY
from edge.inference.onnx_session import load_session
from export.errors import ExportError
from export.graphs.graph import to_model
from firmware_bridge.in_place import check_writable, write_in_place
from firmware_bridge.pad_geometry import USPA44
from train.networks.cost import macs, parameters_count
from train.networks.registry import NETWORKS, build
from train.networks.symmetric import write_out

SCALE: Final = 10


def export_peer(name: str, path: Path, seed: int = 0, scale: int = SCALE) -> str:
    """Write an untrained network, and return a line that describes it.

    Args:
        name: one of train.networks.registry.NETWORKS.
        path: file to write.
        seed: of its weights.
        scale: pattern pixels per taxel pitch.

    Raises:
        ValueError: no network of that name, or the scale is out of range.
        ExportError: torch returns no graph.
        OSError: the file cannot be written.
    """
    torch.manual_seed(seed)
    net = build(name, scale).eval()
    write_out(net)
    check_writable(path)  # before the work, not after it
    model = to_model(net, USPA44)
    model.metadata_props.add(key=WEIGHTS_KEY, value=f"random, of {name}, seed {seed}")
    content = model.SerializeToString(deterministic=True)
    write_in_place(path, lambda draft: draft.write_bytes(content), load_session)
    work = f"{parameters_count(net) / 1e6:.2f} M weights, {macs(net) / 1e6:.1f} MMAC"
    return f"{path}: {name} x{scale}, {work}, {len(content) / 1e6:.2f} MB, weights random, seed {seed}"


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m export.peer", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("network", choices=NETWORKS, metavar="NETWORK", help=f"one of {', '.join(NETWORKS)}")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".onnx file to write")
    parser.add_argument("--seed", type=int, default=0, help="seed of the weights (default: 0)")
    parser.add_argument("--scale", type=int, default=SCALE, help=f"pixels per taxel pitch (default: {SCALE})")
    options = parser.parse_args(arguments)
    try:
        sys.stdout.write(export_peer(options.network, options.out, options.seed, options.scale) + "\n")
    except (ExportError, ValueError) as error:
        sys.exit(f"peer: {error}")
    except OSError as error:
        sys.exit(f"peer: {error.filename}: {error.strerror}")


if __name__ == "__main__":
    main()
