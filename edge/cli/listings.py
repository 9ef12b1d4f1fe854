"""`edge-sr models` and `edge-sr devices`: what is bundled, and what is plugged in."""

import argparse
import time
from collections.abc import Sequence
from typing import Final, TextIO

import numpy as np

from edge.api import DEFAULT_MODEL, POSED_MODEL, Model, ModelError, bundled_models, load_model
from edge.terminal.argument_types import columns, wrapped
from edge.terminal.progress_bar import tracked
from firmware_bridge.errors import DeviceError, as_typed
from firmware_bridge.links.discovery import Found, devices
from firmware_bridge.schedule import RATE_HZ, Ticker

TICKS: Final = 150


def show_models(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Print the bundled models with their error, and with --measure their run time on this machine."""
    paths = bundled_models()
    if not paths:
        raise ModelError("no models are bundled with this installation")
    models = [load_model(path) for path in paths]
    took_us = run_times_us(models) if options.measure else []
    widest = max(len(path.stem) for path in paths)
    times = " p50 us p99 us" if took_us else ""
    shown = {"psnr_db": "7.1f", "rmse_percent": "6.2f", "boundary_mm": "7.2f"}
    out.write(f"{'model':{widest}s} taps   MB arithmetic PSNR dB RMSE % edge mm{times}\n")
    for index, (path, model) in enumerate(zip(paths, models, strict=True)):
        contract = model.contract
        error = contract.test_error.get(str(contract.taps), {})
        figures = "".join(
            f" {error[name]:{width}}" if name in error else f" {'-':>{width[0]}s}" for name, width in shown.items()
        )
        cells = f"{path.stem:{widest}s} {contract.taps:4d} {path.stat().st_size / 1e6:4.1f} {contract.arithmetic:10s}"
        times = "".join(f" {us:6.0f}" for us in took_us[index]) if took_us else ""
        default = {DEFAULT_MODEL: " default", POSED_MODEL: " with poses"}.get(path.stem, "")
        out.write(f"{cells}{figures}{times}{default}\n")
    out.write("Errors on the frozen test set, with all taps; docs/models.md helps to choose.\n")
    if took_us:
        out.write(f"run times of {TICKS} patterns each at {RATE_HZ:g} Hz, on one thread\n")


def run_times_us(models: Sequence[Model]) -> list[tuple[float, float]]:
    """Return median and 99th percentile of each model's run time in [us] on random windows, paced as on a robot."""
    rng, made = np.random.default_rng(1), list[tuple[float, float]]()
    for model in tracked(models, "run times", "model"):
        contract = model.contract
        shape = (16, contract.taps, 3, contract.rows, contract.cols)
        windows = (rng.standard_normal(shape) * 1000).astype(np.float32)
        ticker, took_us = Ticker(RATE_HZ), list[float]()
        for tick in range(TICKS):
            ticker.wait()
            start_ns = time.perf_counter_ns()
            model.run(contract.scale_window(windows[tick % len(windows)]))
            took_us.append((time.perf_counter_ns() - start_ns) / 1e3)
        p50, p99 = np.percentile(took_us, [50, 99], method="inverted_cdf")
        made.append((float(p50), float(p99)))
    return made


def show_devices(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Print the devices, opening none, what to type to read each, and what prevents its use."""
    listed, notes = devices()
    out.write("".join(f"{line}\n" for line in page(listed, notes, columns())))
    if not any(device.adapter for device in listed):
        raise DeviceError(
            "no adapter found: check both plugs of a VScom (the second is the sensor's power), the lines of `dmesg` "
            "since it was plugged in, and that this user is in the group dialout"
        )


def page(listed: Sequence[Found], notes: Sequence[str], width: int) -> list[str]:
    """Return lines for a reader, adapters first; only text to be typed and longer words are wider than `width`."""
    lines: list[str] = []
    for device in sorted(listed, key=lambda device: not device.adapter):
        serial = f"serial {device.serial_number}" if device.serial_number else None
        lines += wrapped("  ".join(word for word in (device.path, device.usb_id, serial) if word), width, indent="  ")
        lines += wrapped(f"{'looks like ' if device.adapter else ''}{device.looks_like}", width, "  ", "  ")
        lines.append(f"  --source {as_typed(device.source)}")
        for problem in device.problems:
            lines += wrapped(problem, width, "  ! ", "    ")
    hint = "The vendor's server, where one runs, is not searched for: --source xela-server:ws://HOST:5000"
    for note in (*notes, hint):
        lines += wrapped(note, width)
    return lines
