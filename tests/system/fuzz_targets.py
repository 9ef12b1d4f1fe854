"""Targets of the fuzzer: every parser of outside input, with valid inputs to begin with.

A target takes bytes and returns; only the errors that a parser documents are caught. `python tests/system/fuzz.py` runs
them guided by coverage, tests/hostile/test_fuzz.py for some seconds without.
"""

from collections.abc import Callable
from dataclasses import dataclass

from fuzz_models import (
    contract,
    contract_seeds,
    frozen,
    frozen_seeds,
    model,
    model_seeds,
    onnx_seeds,
    onnx_walk,
    sequences,
    sequences_seeds,
)
from fuzz_recordings import (
    baseline,
    baseline_seeds,
    csv,
    csv_rate,
    csv_rate_seeds,
    csv_rows,
    csv_rows_seeds,
    csv_seeds,
    mcap,
    mcap_seeds,
    npy_in_npz,
    npy_in_npz_seeds,
    npz,
    npz_seeds,
    sensor_toml,
    sensor_toml_seeds,
)
from fuzz_wire import (
    commands,
    commands_seeds,
    gs_usb,
    gs_usb_limits,
    gs_usb_limits_seeds,
    gs_usb_seeds,
    server,
    server_seeds,
    slcan,
    slcan_seeds,
)


@dataclass(frozen=True)
class Target:
    """Parser that is fuzzed.

    Attributes:
        name: name of its format.
        run: function of one input; raises where a promise is broken.
        seeds: valid inputs to begin with.
        longest: most bytes of an input.
        share: share of the inputs of a long run; slow parsers get fewer.
    """

    name: str
    run: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]
    longest: int = 4096
    share: int = 1


TARGETS = {
    target.name: target
    for target in (
        Target("slcan", slcan, slcan_seeds, 1024, 60),
        Target("gs_usb", gs_usb, gs_usb_seeds, 1024, 100),
        Target("gs_usb limits", gs_usb_limits, gs_usb_limits_seeds, 64, 50),
        Target("server JSON", server, server_seeds, 8192, 50),
        Target("sensor TOML", sensor_toml, sensor_toml_seeds, 4096, 30),
        Target("CSV", csv, csv_seeds, 4096, 50),
        Target("CSV rows", csv_rows, csv_rows_seeds, 1024, 100),
        Target("CSV rate", csv_rate, csv_rate_seeds, 512, 10),
        Target("npz", npz, npz_seeds, 4096, 20),
        Target("MCAP", mcap, mcap_seeds, 8192, 20),
        Target("npy in npz", npy_in_npz, npy_in_npz_seeds, 1024, 10),
        Target("baseline JSON", baseline, baseline_seeds, 8192, 80),
        Target("commands", commands, commands_seeds, 4096, 200),
        Target("contract", contract, contract_seeds, 4096, 5),
        Target("ONNX walk", onnx_walk, onnx_seeds, 4096, 180),
        Target("ONNX model", model, model_seeds, 8192, 10),
        Target("frozen set", frozen, frozen_seeds, 8192, 10),
        Target("sequences", sequences, sequences_seeds, 8192, 10),
    )
}
