"""Identify a sensor from its own recordings: the gains of its channels, and constants of its pad.

    python -m train.identify recordings --out sensor.toml

RECORDINGS is a folder of TRIAL/xela_SENSOR.csv; one trial has to end with a free pad, from which all are zeroed.
Constants that contacts determine are written into the sensor file's [pad] section with their 90 % intervals; constants
that remain as open as the range of simulated pads are left out.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import CONTACTS
from edge.perception.gain_learning import load_contact_model
from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.scans.pad_constants import PAD_RANGES, Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import changing, save_sensor_file
from train.data.real_grips import recorded_sets, recording_paths
from train.errors import DatasetError, ended_by_errors
from train.learning.contact_mixture import CONSTANTS, learned, normalise
from train.physics.pad_draws import RANGES


def recorded_contacts(folder: Path) -> dict[str, NDArray[np.float32]]:
    """Return the distinct contacts (n, 3, rows, cols) of each sensor.

    DatasetError if there are none, or one cannot be read.
    """
    if not recording_paths(folder):
        raise DatasetError(f"{folder} holds no recordings: expected a folder of TRIAL/xela_SENSOR.csv")
    sets = recorded_sets(folder)
    return {
        sensor: distinct(np.concatenate([one.counts for one in sets if one.sensor == sensor]))
        for sensor in dict.fromkeys(one.sensor for one in sets)
    }


def distinct(counts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the scans that differ from all kept before them: a held grip is one contact, however long."""
    contacts, _ = normalise(counts)
    kept: list[int] = []
    for number, contact in enumerate(contacts):
        away = contacts[kept] - contact
        # A tenth of the RMS of z is five times the effect of noise and drift.
        if not kept or np.sqrt((away**2).mean(axis=1)).min() > 0.1:
            kept.append(number)
    return counts[kept]


def extended(path: Path, pads: Mapping[str, Pad]) -> SensorFile:
    """Return the existing sensor file with these pads, or a new one with these pads alone."""
    before = load_sensor_file(path) if path.exists() else SensorFile()
    sensors = dict(before.sensors)
    for name, pad in pads.items():
        entry = sensors.get(name, SensorEntry(assumed=frozenset(("mounting",))))
        sensors[name] = replace(entry, pad=pad)
    return replace(before, sensors=sensors)


def table(sensor: str, contacts: int, pad: Pad) -> str:
    """Return the pad of a sensor as lines of text."""
    lines = [
        f"{sensor}: {contacts} distinct contacts",
        f"{'constant':18} {'prior':>18} {'estimate':>10}  90 % interval",
    ]
    for name in (name for name in CONSTANTS if name in PAD_RANGES):
        known = f"{'-':>10}  not determined by these contacts"
        if name in pad.constants:
            known = f"{pad.constants[name]:10.4g}  " + "{:.4g} .. {:.4g}".format(*pad.intervals[name])
        lines.append(f"{name:18} {'{:.4g} .. {:.4g}'.format(*RANGES[name]):>18} {known}")
    gains, width = (np.asarray(values).reshape(USPA44.scan_shape) for values in (pad.gains, pad.gain_half_widths))
    for axis, plane, half in zip(AXES, gains, width, strict=True):
        lines.append(f"gains of {axis}, each within {100 * half.min():.0f} to {100 * half.max():.0f} % of:")
        lines += ["  " + "  ".join(f"{gain:.3f}" for gain in row) for row in plane]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m train.identify", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", type=Path, metavar="RECORDINGS", help="a folder of TRIAL/xela_SENSOR.csv")
    parser.add_argument("--out", type=Path, metavar="SENSOR.toml", help="a sensor file to extend or to write")
    options = parser.parse_args(arguments)
    with ended_by_errors("train.identify"):
        contacts = recorded_contacts(options.recordings)
        model = load_contact_model(CONTACTS)
        pads = {}
        for sensor, counts in contacts.items():
            learner = learned(counts, model)
            name = sensor.removeprefix("xela_")
            pads[name] = learner.pad()
            sys.stdout.write(table(name, learner.contacts, pads[name]) + "\n")
        if options.out is not None:
            with changing(options.out):
                save_sensor_file(options.out, extended(options.out, pads))
            sys.stdout.write(f"{options.out}: pads of {', '.join(pads)}\n")


if __name__ == "__main__":
    main()
