"""Identify a sensor from its own recordings: the gains of its channels, and constants of its pad.

    python -m train.identify recordings --out sensor.toml
    python -m train.identify ball.mcap --ball-mm 40 --out sensor.toml

RECORDINGS is a folder of TRIAL/xela_SENSOR.csv; one trial has to end with a free pad, from which all are zeroed. With
--ball-mm it is one recording in which a ball of that diameter was pressed onto the pad several times. Constants that
these determine are written into the sensor file's [pad] section with their 90 % intervals.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import CONTACTS_FILE
from edge.perception.gain_learning import load_contact_model
from edge.terminal.argument_types import positive
from firmware_bridge.pad_geometry import AXES, USPA44
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import changing, save_sensor_file
from train.data.real_grips import recorded_contacts
from train.data.recorded_taps import recorded_presses
from train.errors import DatasetError, ended_by_errors
from train.learning.ball_fit import fit_ball
from train.learning.contact_mixture import learned, normalise
from train.physics.pad_draws import RANGES


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


def contact_pads(folder: Path, file: SensorFile) -> dict[str, tuple[str, Pad]]:
    """Return of each sensor of a folder how many distinct contacts it has, and its pad; DatasetError if none."""
    model, told = load_contact_model(CONTACTS_FILE), {}
    for sensor, counts in recorded_contacts(folder, file).items():
        if len(dead := np.flatnonzero((np.ptp(counts, axis=0) == 0).all(axis=0))):
            raise DatasetError(
                f"taxel {dead[0]} (row by row, from 0) of {sensor} reads the same in all contacts, expected a whole "
                "sensor: a dead taxel makes the gains of all others wrong"
            )
        learner = learned(distinct(counts), model)
        told[sensor.removeprefix("xela_")] = f"{learner.contacts} distinct contacts", learner.pad()
    return told


def ball_pads(path: Path, diameter_mm: float, file: SensorFile) -> dict[str, tuple[str, Pad]]:
    """Return of each sensor that a ball is pressed onto in a recording how many presses these are, and its pad by them.

    A constant of the sensor file without an interval was entered by a person: it is taken as known, and kept. One with
    an interval was measured, and is measured anew: taken as known, the same presses would count again with each call.
    RecordingError, BaselineRefusedError or DatasetError if there are too few, or they are not of that ball.
    """
    recording, pads = load_recording(path), {}
    for track in recording.tracks:
        name = track.sensor.removeprefix("xela_")
        if path.suffix.lower() == ".csv" and name not in file.sensors and len(file.sensors) == 1:
            name = next(iter(file.sensors))  # a CSV does not state its sensor
        entry = file.sensors.get(name, SensorEntry())
        presses = recorded_presses(recording, entry, track.sensor)
        recording = replace(recording, notes=())  # which were printed with the first track
        if not presses and len(recording.tracks) > 1:
            continue  # the other finger
        if entry.counts_per_newton is None or entry.counts_per_newton_interval is None:
            raise DatasetError(
                f"counts per newton of sensor {name} are not in the sensor file, and a ball needs them: "
                "lay a weight on the pad with edge-sr doctor, and pass its file as --out"
            )
        pad = entry.pad or Pad()
        known = replace(
            entered(pad),
            counts_per_newton=entry.counts_per_newton,
            intervals={"counts_per_newton": entry.counts_per_newton_interval},
            gains=pad.gains,
            gain_half_widths=pad.gain_half_widths,
        )
        scans = [rising for rising, _ in presses]
        pads[name] = f"{len(presses)} presses of a ball", fit_ball(scans, diameter_mm, known)
    if not pads:
        raise DatasetError(f"{path} has no press on any sensor: press the ball alone, slowly, all over the pad")
    return pads


def entered(pad: Pad) -> Pad:
    """Return the constants of a sensor file's pad that a person entered: those without an interval."""
    return Pad(**dict[str, Any]({name: value for name, value in pad.constants.items() if name not in pad.intervals}))


def extended(before: SensorFile, pads: Mapping[str, Pad]) -> SensorFile:
    """Return a sensor file with these pads: what a person entered stays, and what these do not determine."""
    sensors = dict(before.sensors)
    for name, pad in pads.items():
        entry = sensors.get(name, SensorEntry(assumed=frozenset(("mounting",))))
        there = entry.pad or Pad()
        sensors[name] = replace(entry, pad=there.behind(pad.behind(entered(there))))
    return replace(before, sensors=sensors)


def table(sensor: str, contacts: str, pad: Pad) -> str:
    """Return the pad of a sensor as lines of text."""
    lines = [
        f"{sensor}: {contacts}",
        f"{'constant':18} {'prior':>18} {'estimate':>10}  90 % interval",
    ]
    for name in RANGES:
        known = f"{'-':>10}  not determined by these contacts"
        if name in pad.constants:
            ends = "{:.4g} .. {:.4g}".format(*pad.intervals[name]) if name in pad.intervals else "entered by hand"
            known = f"{pad.constants[name]:10.4g}  {ends}"
        lines.append(f"{name:18} {'{:.4g} .. {:.4g}'.format(*RANGES[name]):>18} {known}")
    if pad.gains is None or pad.gain_half_widths is None:
        return "\n".join(lines)
    gains, width = (np.asarray(values).reshape(USPA44.scan_shape) for values in (pad.gains, pad.gain_half_widths))
    for axis, plane, half in zip(AXES, gains, width, strict=True):
        lines.append(f"gains of {axis}, each within {100 * half.min():.0f} to {100 * half.max():.0f} % of:")
        lines += ["  " + "  ".join(f"{gain:.3f}" for gain in row) for row in plane]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m train.identify", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("recordings", type=Path, metavar="RECORDINGS", help="a folder of TRIAL/xela_SENSOR.csv, or presses of a ball")
    add("--ball-mm", type=partial(positive, low=4.0, high=200.0), metavar="D", help="diameter of that ball in mm")
    add("--out", type=Path, metavar="SENSOR.toml", help="a sensor file to extend or to write")
    options = parser.parse_args(arguments)
    with ended_by_errors("train.identify"):
        file = _file(options.out)
        if options.ball_mm is None:
            told = contact_pads(options.recordings, file)
        else:
            told = ball_pads(options.recordings, options.ball_mm, file)
        pads = {name: pad for name, (_, pad) in told.items()}
        for name, pad in extended(file, pads).measured_pads.items():
            if name in told:
                sys.stdout.write(table(name, told[name][0], pad) + "\n")
        if options.out is not None:
            with changing(options.out):  # which another program may have changed meanwhile
                save_sensor_file(options.out, extended(_file(options.out), pads))
            new = {} if file.path is None else told.keys() - file.sensors.keys()
            names = ", ".join(f"{name}, which was not in it" if name in new else name for name in told)
            sys.stdout.write(f"{options.out}: pads of {names}\n")


def _file(path: Path | None) -> SensorFile:
    return SensorFile() if path is None or not path.exists() else load_sensor_file(path)


if __name__ == "__main__":
    main()
