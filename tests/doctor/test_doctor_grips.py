"""Guided grips of a flat face: by themselves, and over a pseudo-terminal on a sensor with simulated gains."""

import json
import re

import numpy as np
import pytest
from test_doctor_command import Person, doctor, recording, verdicts

from edge.doctor import write_sensor_file as keep
from edge.doctor.flat_grip_gains import grip_features, load_table
from edge.doctor.flat_grip_guide import GuidedGrips
from edge.doctor.grip_findings import judge_grips
from edge.doctor.pad_orientation import AS_MAPPED, orders
from edge.doctor.press_guide import PATIENCE_S
from edge.errors import EdgeError
from edge.inference.bundled import FLAT_GRIPS
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import load_sensor_file
from train.data.grip_ramps import DRAGS, LEVELS
from train.learning.flat_grips import draw_gains, grips_of_pad, log_gains

PERIOD_S = 0.01


@pytest.fixture(scope="module")
def gripped():
    """Readings of three grips (3, scans, 3, 4, 4) of one simulated sensor, and its true log-gains (48,)."""
    clean, seats = grips_of_pad(9015, 3)
    chips = draw_gains([9015, 3])
    return clean * chips, log_gains(chips, seats).ravel()


def played(moments, scans):
    """Return as many scans as asked between the moments of a part of a grip."""
    at = np.linspace(0, len(moments) - 1, scans)
    low = np.floor(at).astype(int).clip(0, len(moments) - 2)
    return moments[low] + (at - low)[:, None, None, None] * (moments[low + 1] - moments[low])


def parts(grip):
    return (
        played(np.concatenate([np.zeros((1, 3, 4, 4)), grip[:LEVELS]]), 60),
        played(grip[LEVELS : LEVELS + DRAGS], 40),
        played(grip[LEVELS + DRAGS :], 40),
    )


def answer_to(script, guide=None):
    """Return every request and the guide after these readings."""
    guide = guide or GuidedGrips()
    asked = [guide.first]
    for index, zeroed in enumerate(script):
        request = guide.push(np.asarray(zeroed, dtype=np.float32), index * PERIOD_S)
        asked += [request] if request else []
    return asked, guide


def visit(grips, held=30):
    script = []
    for grip in grips:
        for part in parts(grip):
            script += [*part, *[part[-1]] * held]
        script += [np.zeros((3, 4, 4))] * 40
    return np.array(script) + np.random.default_rng(1).normal(0, 2, (len(script), 3, 4, 4))


def error_of(pad, true):
    """Return the RMS error of log-gains about each axis' mean, and the share within the intervals."""
    error = (np.log(pad.gains) - true).reshape(3, 16)
    inside = np.abs(error.ravel()) <= pad.gain_half_widths
    return float(np.sqrt(((error - error.mean(axis=1, keepdims=True)) ** 2).mean())), inside.mean()


def test_three_grips_give_the_gains_of_a_sensor(gripped):
    readings, true = gripped
    asked, guide = answer_to(visit(readings))
    assert guide.done and [one[:11] for one in asked[::4]] == ["Grip 1 of 3", "Grip 2 of 3", "Grip 3 of 3"]
    finding, pad = judge_grips(guide, None, kept=True)
    assert finding.verdict == "ok" and pad is not None
    error, inside = error_of(pad, true)
    assert error < 0.03 < np.sqrt((true**2).mean()) / 2
    assert inside > 0.75
    assert pad.gains_certainty > 0.5


def test_without_a_push_x_and_y_stay_open(gripped):
    readings, true = gripped
    script = []
    for grip in readings:
        grown = parts(grip)[0]
        script += [*grown, *[grown[-1]] * 30, *[np.zeros((3, 4, 4))] * 40]
    guide = answer_to(script)[1]
    finding, pad = judge_grips(guide, None, kept=True)
    assert finding.verdict == "look" and "push the object sideways" in finding.remedy
    widths = np.reshape(pad.gain_half_widths, (3, 16))
    assert widths[:2].min() > 2 * widths[2].max()
    z_error = (np.log(pad.gains) - true)[32:]
    assert np.sqrt((z_error**2).mean()) < 0.045


def test_a_face_that_does_not_cover_the_pad_is_asked_for_again(gripped):
    readings, _ = gripped
    half = 2.4 * readings
    half[..., :2] = 0
    asked, guide = answer_to(visit(half[:1]))
    assert len(guide.grips) == 0 and any(
        one.startswith("Once more, it did not cover the pad. Grip 1 of 3") for one in asked
    )
    finding, pad = judge_grips(guide, None, kept=True)
    assert (
        finding.verdict == "not known"
        and "0 of 3 flat grips felt, it did not cover" in finding.measured
        and pad is None
    )


def test_nobody_grips():
    guide = GuidedGrips()
    for index in range(3):
        guide.push(np.zeros((3, 4, 4), dtype=np.float32), index * PATIENCE_S)
    assert guide.done and judge_grips(guide, None, kept=False)[0].verdict == "not known"


def test_a_grip_that_does_not_grow_tells_nothing(gripped):
    readings, _ = gripped
    steady = np.repeat(readings[:1, LEVELS - 1], 50, axis=0)
    assert grip_features([steady]) is None
    assert load_table(FLAT_GRIPS).gains([steady]) is None


def test_a_table_that_is_none_is_named(tmp_path):
    np.savez(tmp_path / "t.npz", mean=np.zeros(3), covariance=np.eye(3), widening=1.0)
    with pytest.raises(EdgeError, match=r"t\.npz cannot be read .*train\.learning\.flat_grips"):
        load_table(tmp_path / "t.npz")


class Gripping(Person):
    """Person who grips a flat block as asked, with a sensor of these readings, given along the pad's axes."""

    def __init__(self, grips, mounting=None) -> None:
        super().__init__(mounting)
        self._parts = [list(parts(grip)) for grip in grips]
        self._script = iter(())

    def hear(self, text: str) -> None:
        super().hear(text)
        if "et go" in text:
            self._script = iter(())
        grip = re.search(r"Grip (\d) of", text)
        if grip:
            self._now = self._parts[int(grip[1]) - 1]
        for at, words in enumerate(("Grip ", "push it sideways", "Now push it across")):
            if words in text:
                self._script = iter(self._now[at])

    def __iter__(self):
        counts = super().__iter__()
        while True:
            self._felt = next(self._script, self._felt)
            yield next(counts)


@pytest.mark.parametrize(
    ("turn", "swap", "signs"), [(AS_MAPPED, False, (1, 1, 1)), ("mirrored left to right", True, (-1, 1, -1))]
)
def test_the_doctor_finds_simulated_gains_over_a_pseudo_terminal(monkeypatch, tmp_path, gripped, turn, swap, signs):
    readings, true = gripped
    file = tmp_path / "sensor.toml"
    monkeypatch.setattr(keep, "serial_ports", list)
    person = Gripping(readings, Mounting(orders()[turn], swap, signs))
    with Emulator([recording(person, rate_hz=400.0)], jitter_s=0) as emulator:
        asked = ("--rate-hz", 400, "--json", "--weight-g", 200, "--out", file)
        done = doctor(monkeypatch, emulator.port, *asked, people=[person], drift_s=0.5)
    found = {one["name"]: one for one in json.loads(done.out)["findings"]}
    assert found["gains"]["verdict"] == "ok", done.out
    entry = load_sensor_file(file).sensors["4"]
    assert entry.pad is not None and entry.mounting.order == orders()[turn]
    error, inside = error_of(entry.pad, true)
    assert error < 0.03 and inside > 0.75
    assert entry.counts_per_newton is not None and "gains" in entry.emulated
    assert verdicts(done).keys() <= {"taxel order", "axis signs"}
