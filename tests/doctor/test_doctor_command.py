"""`edge-sr doctor` over a real pseudo-terminal: an emulated sensor, its faults, and a person who obeys prompts."""

import io
import json
import os
import re
import signal
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from itertools import chain, repeat
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cli_samples import write_recording
from doctor_samples import REST, Person, as_scans, healthy_counts
from edge_samples import FakeLink

from edge.api import load_sensor_file
from edge.cli import main as cli
from edge.cli.main import parser
from edge.doctor import command, examine, rehearsal
from edge.doctor.guided_press import ASK_WEIGHT, orders
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.serial_ports import Port
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.mounting import Mounting


class Terminal(io.StringIO):
    """Terminal that shows prompts to people, who type a line of `typed`, or Enter alone, where grams are asked for."""

    def __init__(self, people: Sequence[Person] = (), typed: Sequence[str] = ()) -> None:
        super().__init__()
        self._people, self._typed = people, chain(typed, repeat(""))
        self.keyboard, self.stdin = os.openpty()

    def isatty(self) -> bool:
        return bool(self._people)

    def write(self, text: str) -> int:
        for person in self._people:
            if (line := person.hear(text)) is not None:
                os.write(self.keyboard, line.encode() + b"\n")
        if text == "\n" and " ".join(self.getvalue().split()).endswith(ASK_WEIGHT):
            os.write(self.keyboard, next(self._typed).encode() + b"\n")
        return super().write(text)


def recording(*counts, rate_hz=200.0):
    tracks = [Track(str(number), one, None) for number, one in enumerate(counts)]
    return Recording(Path("made.csv"), tuple(tracks), rate_hz)


TOO_FEW = re.compile(r'\b[1-9]\d? scans(?:", "norm": "| \(norm: )at least|only \d+ complete scans')


def doctor(port, *arguments, **settings):
    """One look; once more, a few times, where the machine stood still for most of it, which is no sensor's fault."""
    for _ in range(4):
        done = look(port, *arguments, **settings)
        if not TOO_FEW.search(" ".join(done.out.split())):
            break
    return done


def visited(person, *arguments, **settings):
    """The same of a pad that a person holds."""
    with Emulator([recording(person, rate_hz=400.0)]) as emulator:
        return doctor(emulator.port, "--rate-hz", 400, *arguments, people=[person], **{"drift_s": 0.4} | settings)


class _Stdin(redirect_stdout):
    _stream = "stdin"


def look(port, *arguments, drift_s=0.7, people=(), typed=()):
    """Return the exit code, the output, and the prompts to the people."""
    out, err = io.StringIO(), Terminal(people, typed)
    with redirect_stdout(out), redirect_stderr(err), _Stdin(os.fdopen(err.stdin)), os.fdopen(err.keyboard):
        rate = () if "--rate-hz" in arguments else ("--rate-hz", 200)
        asked = ("--source", f"slcan:{port}", "--drift-s", drift_s, *rate, *arguments)
        code = cli.main(["doctor", *map(str, asked)])
    return SimpleNamespace(code=code, out=out.getvalue(), err=err.getvalue())


BY_THE_CLOCK = {"rate", "lost scans", "torn scans"}
"""Findings that a busy machine makes as well as a bad sensor: not asserted where nothing is wrong with them."""


def verdicts(done):
    """Return verdicts that are not ok, except by the clock or undecided without a person or an earlier baseline."""
    document = json.loads(done.out)
    assert done.code == (document["verdict"] == "wrong")
    return {
        one["name"]: one["verdict"]
        for one in document["findings"]
        if one["verdict"] != "ok" and one["name"] not in {"load", "guided press"} | BY_THE_CLOCK
    }


def test_a_healthy_sensor_is_0_and_ok_in_every_line(plugged, tmp_path):
    file = tmp_path / "s.toml"
    with Emulator([recording(healthy_counts(200))], loop=True) as emulator:
        plugged.append(Port(str(Path(emulator.port).resolve()), (0x0403, 0x6015), "D30BL366", "adapter"))
        done = doctor(emulator.port, "--json", "--out", file)
    assert load_sensor_file(file).adapter == "D30BL366", "the serial number of the adapter is kept"
    document = json.loads(done.out)
    assert verdicts(done) == {}
    told = {"stopped": False, "kind": "emulated", "sensor_file": str(file), "id_map": "uSPa44"}
    assert document | told == document
    assert len(document["findings"]) == 14
    assert "stdin is not a terminal" in document["findings"][-1]["remedy"]
    assert done.err == f"slcan:{emulator.port}: watching for 0.7 s; keep the pad free and still\n"


def test_the_next_run_goes_by_the_order_axes_and_force_measured(monkeypatch, tmp_path):
    sits = Mounting(orders()["turned by 90 degrees clockwise"], True, (1, -1, -1))
    file = tmp_path / "sensor.toml"
    monkeypatch.setenv("COLUMNS", "40")
    done = visited(Person(sits), "--out", file, typed=["0.2", "200"])
    assert "taxel order: turned" in done.out, done.out
    shown = re.sub(re.escape(str(file)) + "|/dev/\\S+", "", done.out + done.err).splitlines()
    assert [line for line in shown if len(line) > 40] == []
    assert f"python -m train.own {file} --recordings FOLDER --out mine" in " ".join(done.out.split())
    known = load_sensor_file(file)
    entry = known.sensors["4"]
    assert entry.mounting == sits and known.model == "uSPa44" and known.adapter is None
    assert entry.counts_per_newton == pytest.approx(1176, rel=0.02)
    ends = [entry.counts_per_newton * share for share in (0.92, 1.08)]
    assert entry.counts_per_newton_interval == pytest.approx(ends, rel=1e-4)
    in_place = REST.reshape(3, 16)[:, list(sits.order)].reshape(3, 4, 4)
    assert entry.baseline is not None and np.abs(entry.baseline.counts - in_place).max() <= 2

    done = visited(Person(sits), "--json", "--sensor", file, "--out", file, typed=["2000"], drift_s=1.5)
    assert verdicts(done) == {"force": "look"}, done.out
    findings = {one["name"]: one for one in json.loads(done.out)["findings"]}
    assert {findings[name]["verdict"] for name in ("taxel order", "axis signs", "load")} == {"ok"}
    assert "not kept" in findings["force"]["remedy"], "the scale of mistyped grams"
    again = load_sensor_file(file).sensors["4"]
    assert (again.counts_per_newton, again.mounting) == (entry.counts_per_newton, sits)


def test_a_rehearsal_needs_no_sensor_and_gives_none_away(tmp_path, limits):
    limits(rehearsal, ANSWER_S=0.1)
    file, out, err = tmp_path / "practice.toml", io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = cli.main(["doctor", "--rehearse", "--out", str(file)])
    found = re.findall(r"ok    (taxel order|axis signs|force):", out.getvalue())
    assert (code, found) == (0, ["taxel order", "axis signs", "force"]), out.getvalue()
    assert "train.own" not in out.getvalue(), "which takes no emulated sensor"
    assert err.getvalue().count("Still pressing") == 4 and "Lay 200 g" in err.getvalue()
    (entry,) = load_sensor_file(file).sensors.values()
    assert {"mounting", "force", "baseline"} <= entry.emulated
    assert entry.counts_per_newton == pytest.approx(1176, rel=0.02)
    assert cli.main(["doctor", "--rehearse", "--source", "demo"]) == 2


def test_two_sensors_are_pressed_in_turn_and_compared_in_a_grip():
    people = [Person(Mounting(orders()["turned by 180 degrees clockwise"])), Person(grip_counts=5000)]
    with Emulator([recording(*people, rate_hz=120.0)]) as emulator:
        asked = ("--json", "--rate-hz", 120)
        done = doctor(emulator.port, *asked, people=people, typed=["200", "200"], drift_s=1.2)
    findings = json.loads(done.out)["findings"]
    found = {(one["sensor"], one["name"]): one["verdict"] for one in findings}
    assert done.code == 1 and found["4", "taxel order"] == "wrong" and found["6", "taxel order"] == "ok"
    assert "Sensor 4: Press the top left" in done.err and "Sensor 6: Press the top left" in done.err
    assert "Let the gripper close" in done.err
    zeros = {one["measured"][7]: one["verdict"] for one in findings if one["name"] == "zero after a grip"}
    (scale,) = (one for one in findings if one["name"] == "scale in a grip")
    assert zeros == {"4": "ok", "6": "ok"} and scale["verdict"] == "wrong"
    assert "reads 0.80 of the newtons" in scale["measured"]


def examined(open_link, *arguments, out=None, err=None):
    options, out = parser("doctor").parse_args([*map(str, arguments)]), out or io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(examine, "links_to", lambda _, sensor_file, __: ([open_link()], sensor_file))
        return command.run(options, out, err or io.StringIO()), out.getvalue()


def test_a_sensor_that_falls_silent_while_it_is_pressed(limits):
    limits(command, GIVEN_UP_S=0.3)
    link = FakeLink([as_scans(healthy_counts())], endless=True)
    code, out = examined(lambda: link, "--drift-s", 0.1, "--json", err=Terminal([Person()]))
    settled = {one["name"]: one["verdict"] for one in json.loads(out)["findings"]}
    assert code == 1
    assert settled["guided press"] == "wrong" and settled["taxel order"] == "not known"


class Impatient(Person):
    """Presses the first two corners, and types Enter at the others, and before anything is asked."""

    def hear(self, text: str) -> str | None:
        bottom = "bottom" in text and "corner" in text
        super().hear("" if bottom else text)
        return "" if bottom or "watching for" in text else None  # the latter is no answer


def test_enter_skips_a_request_and_a_skipped_one_is_no_success():
    """At the keyboard of a real pseudo-terminal."""
    done = visited(Impatient(), "--json")
    settled = {one["name"]: (one["verdict"], one["measured"]) for one in json.loads(done.out)["findings"]}
    assert settled["taxel order"] == ("not known", "2 of 4 corners measured")
    assert settled["force"] == ("not known", "no weight was laid on")
    assert done.err.count("Skipped. Let go.") == 2 and done.code == 1


class Leaving(Person):
    def __init__(self, at: str) -> None:
        super().__init__()
        self._at = at

    def hear(self, text: str) -> None:
        super().hear(text)
        if self._at in text:
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(("at", "kept"), [("watching for", False), ("the top right corner", True)])
def test_ctrl_c_keeps_a_baseline_that_was_measured_to_the_end(tmp_path, at, kept):
    file = tmp_path / "s.toml"
    done = visited(Leaving(at), "--out", file)
    assert done.code == 130 and "\nstopped after " in done.out
    assert file.exists() == (f"kept in {file}" in done.out) == kept
    assert kept or f"{file}: not written, because the free pad was not measured to the end" in done.err
    for entry in load_sensor_file(file).sensors.values() if kept else ():
        assert entry.baseline is not None and (entry.assumed, entry.emulated) == ({"mounting"}, {"baseline"})


def test_a_cable_pulled_out_is_3_after_what_was_found(tmp_path):
    with Emulator([recording(healthy_counts(150), rate_hz=150.0)]) as emulator:
        done = doctor(emulator.port, "--out", tmp_path / "s.toml", drift_s=30)
    assert done.code == 3 and "link: lost" in done.out and "noise" in done.out
    assert "link lost" in done.err and not (tmp_path / "s.toml").exists()


def test_a_recording_is_examined_but_not_pressed(tmp_path):
    out, err = io.StringIO(), Terminal([Person()])
    write_recording(tmp_path / "r.npz", [0] * 150)
    kept = tmp_path / "sensor.toml"
    with redirect_stdout(out), redirect_stderr(err):
        assert cli.main(["doctor", "--source", f"replay:{tmp_path}/r.npz", "--json", "--out", str(kept)]) == 0
    assert np.isnan(load_sensor_file(kept).baselines["4"].created_unix_s), "nobody knows of when it is"
    document = json.loads(out.getvalue())
    assert document["kind"] == "replay" and not any(one["sensor"] is None for one in document["findings"])
    assert "cannot be pressed" in document["findings"][-1]["remedy"]
