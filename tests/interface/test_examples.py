"""The examples as a user runs them: from an empty directory, without hardware."""

import importlib.util
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
import trimesh
from cli_samples import write_recording
from edge_samples import BASELINE, ROOT, FakeLink, FakeModel, make_scan, write_model
from trust_samples import make_trusted_contract

from edge.api import Note, Result, Source
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.base import Notice
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file

TIMEOUT_S = 120
PATIENT = ("--oldest-ms", "20000")
"""Option for a busy machine; the effect of 100 ms is tested with scans of any age."""


def start(folder, name, *arguments):
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=folder, text=True, **pipes)


def run(folder, name, *arguments, timeout_s=TIMEOUT_S):
    process = start(folder, name, *arguments)
    out, errors = process.communicate(timeout=timeout_s)
    return process.returncode, out.splitlines(), errors.splitlines()


@pytest.fixture
def empty(tmp_path):
    (tmp_path / "empty").mkdir()
    return tmp_path / "empty"


def loaded(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("typed", "why"),
    [
        ("print_force --source slcan:/dev/none", "print_force: /dev/none"),
        ("stop_on_area --area-mm2 9 --source slcan:/dev/none", "stop_on_area: /dev/none"),
        ("stop_on_area --area-mm2 9 --source demo", "stop_on_area: demo is emulated, not a sensor: pass --pretend to"),
        ("train_and_deploy a.stl --out /dev/null/a", "train_and_deploy: /dev/null/a/work: Not a directory"),
    ],
)
def test_what_cannot_be_is_one_line_before_anything_is_begun(empty, typed, why, argv, capsys, monkeypatch):
    monkeypatch.chdir(empty)
    argv(typed.split())
    terminated = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as end:
            loaded(typed.partition(" ")[0]).main()
    finally:
        signal.signal(signal.SIGTERM, terminated)
    assert str(end.value).startswith(why) and "\n" not in str(end.value)
    assert capsys.readouterr() == ("", "") and list(empty.iterdir()) == []


def test_the_force_is_printed_scan_by_scan(empty):
    code, out, errors = run(empty, "print_force.py", "--source", "demo", "--duration-s", "3")
    assert code == 0 and len(out) > 150 and {line.split()[0] for line in out} == {"EMULATED"}
    assert "zeroing" in out[0] and "idle" in out[-1] + out[110] and " counts" in out[110]
    assert len(errors) == 1 and errors[0].startswith("sensor 4: ") and errors[0].endswith(" scans a second")
    assert list(empty.iterdir()) == []


def test_the_gripper_stops_on_contact(empty):
    code, out, errors = run(empty, "stop_on_area.py", "--source", "demo", "--area-mm2", "20", *PATIENT, "--pretend")
    assert (code, errors) == (0, []) and out[:2] == ["gripper: closing", "gripper: stopped"]
    assert " mm2 touch, as felt " in out[2] and len(out) == 3


def known(folder):
    """Write a pad at rest, a model with checks and a sensor file; return the options of a gripper that uses them."""
    write_recording(folder / "rest.npz", [0] * 100)
    write_model(folder / "tiny.onnx", make_trusted_contract())
    save_sensor_file(folder / "s.toml", SensorFile(sensors={"4": SensorEntry(baseline=BASELINE)}))
    given = ("--model", folder / "tiny.onnx", "--sensor", folder / "s.toml", "--area-mm2", "20", "--pretend")
    return *given, *PATIENT


def test_a_reader_that_has_had_enough_is_no_trouble(empty, tmp_path):
    process = start(empty, "print_force.py", "--source", "demo")
    assert "zeroing" in process.stdout.readline()
    process.stdout.close()
    assert (process.stderr.read(), process.wait(TIMEOUT_S)) == ("", 0)
    process = start(empty, "stop_on_area.py", "--source", f"replay:{tmp_path}/rest.npz", *known(tmp_path))
    process.stdout.close()
    assert (process.stderr.read(), process.wait(TIMEOUT_S)) == ("", 1)


@pytest.mark.parametrize("number", [None, signal.SIGTERM, signal.SIGINT])
def test_a_pulled_cable_and_a_kill_stop_the_gripper(empty, tmp_path, number):
    options = known(tmp_path)
    with Emulator([load_recording(tmp_path / "rest.npz")], loop=True) as emulator:
        process = start(empty, "stop_on_area.py", "--source", f"slcan:{emulator.port}", *options)
        try:
            assert process.stdout.readline() == "gripper: closing\n"
            if number is None:
                emulator.hang_up()
            else:
                process.send_signal(number)
            out, errors = process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()
    first, _, why = out.partition("\n")
    assert first == "gripper: stopped"
    if number is None:
        assert process.returncode == 1 and errors == "" and why.startswith("why: ") and "lost" in why
    else:
        assert process.returncode == 128 + number and why == ""


@pytest.fixture(scope="module")
def stop_on_area():
    return loaded("stop_on_area")


@pytest.fixture
def at_once(stop_on_area, limits):
    """The example, which knows with the first reading which sensors there are."""
    limits(stop_on_area, SETTLING_NS=0)
    return stop_on_area


def grip_of(module, **settings):
    done = []
    gripper = SimpleNamespace(close=lambda: done.append("close"), stop=lambda: done.append("stop"))
    return module.Grip(gripper, 20.0, **({"most_counts": 20_000, "oldest_ms": 100} | settings)), done


def reading(state="idle", sensor="4", **said):
    scan = replace(make_scan(sensor=sensor), time_ns=time.monotonic_ns() - said.pop("age_ms", 0) * 1_000_000)
    return Result(scan, "device", "tiny", state, **({"force_counts": 10.0} | said))


SILENT = Note("dead", "taxel 3 was not received")
DOUBT = Note("baseline_in_doubt", "zero again")
UNTRUSTED = {"trusted": False, "untrusted_reason": "unfamiliar"}
WRONG = {
    "the reading is 50": {"age_ms": 5000},
    "taxels [5] are dead": {"dead": {5: "stuck"}},
    "not ready: taxel 3 was not received": {"state": "incomplete", "notes": (SILENT,), "force_counts": None},
    "not ready: zeroing": {"state": "zeroing", "force_counts": None},
    "not to be believed: readings like no contact": {"state": "contact", "area_mm2": 50.0} | UNTRUSTED,
    "50 mm2 touch": {"state": "contact", "area_mm2": 50.0},
    "not ready: zero again": {"state": "baseline_in_doubt", "notes": (DOUBT,), "trusted": False, "area_mm2": 50.0},
    "the force is 21000 counts": {"state": "dropped", "force_counts": 21_000.0},
}


@pytest.mark.parametrize("words", WRONG)
def test_the_gripper_neither_begins_nor_goes_on_by_a_bad_reading(at_once, words):
    grip, done = grip_of(at_once, oldest_ms=2000)
    grip.follow(reading(**WRONG[words]))
    assert done == [] and grip.why.startswith("it never began: ") and words in grip.why
    grip.follow(reading())
    grip.follow(reading("contact", area_mm2=19.0))
    assert done == ["close"]
    grip.follow(reading(**WRONG[words]))
    assert done == ["close", "stop"] and words in grip.why and not grip.reached


def test_it_begins_when_every_sensor_is_free_and_any_stops_it(stop_on_area):
    grip, done = grip_of(stop_on_area, oldest_ms=20_000)
    grip.follow(reading(sensor="left", age_ms=1000))
    grip.follow(reading(sensor="left", age_ms=600))
    assert done == []  # the other one may not have sent yet
    grip.follow(reading("zeroing", "right", force_counts=None))
    grip.follow(reading(sensor="left"))
    grip.follow(reading("contact", "right", area_mm2=5.0))
    grip.follow(reading(sensor="left"))
    assert done == []
    grip.follow(reading(sensor="right"))
    assert done == ["close"]
    grip.follow(reading("contact", "right", area_mm2=20.0, trusted=True))
    assert done == ["close", "stop"] and grip.reached


def test_a_silent_sensor_stops_it_though_the_other_still_sends(at_once, monkeypatch):
    alone, its_own = grip_of(at_once, name="left")  # of several sensors one alone may be gone by
    alone.follow(reading("contact", "right", area_mm2=50.0))
    alone.follow(reading(sensor="left"))
    alone.follow(reading("zeroing", "right", force_counts=None))
    assert its_own == ["close"]
    grip, done = grip_of(at_once, oldest_ms=2000)
    for age_ms in (1000, 900):
        for sensor in ("left", "right"):
            grip.follow(reading(sensor=sensor, age_ms=age_ms))
    assert done == ["close"]
    later_ns = time.monotonic_ns() + 3 * 10**9
    monkeypatch.setattr(time, "monotonic_ns", lambda: later_ns)
    grip.follow(reading(sensor="left"))
    assert done == ["close", "stop"] and grip.why.startswith("no reading of sensor right for 3")


class Live(FakeLink):
    """Link of scans of this moment, with notices after ten reads."""

    told: tuple[str, ...] = ()

    def notices(self):
        return [Notice(0, kind, f"fake is {kind}") for kind in self.told] if self.reads == 11 else []

    def read(self, timeout_s):
        time.sleep(0.005)
        return [replace(scan, time_ns=time.monotonic_ns()) for scan in super().read(timeout_s)]


@pytest.mark.parametrize(
    ("sensors", "settings", "words"),
    [
        ("4", {"endless": True}, "no reading of sensor 4 for "),
        ("4", {}, "no more readings"),
        ("4", {"told": ("lost",)}, "fake is lost"),
        ("4", {"told": ("trouble",)}, "fake is trouble"),
        ("46", {}, "it never began: "),  # the other one that is known was not heard
    ],
)
def test_the_gripper_stands_still_however_it_ends(at_once, sensors, settings, words):
    told = settings.pop("told", ())
    link = Live([[make_scan(n)] for n in range(30 if told else 10)], **settings)
    link.told = told
    grip, done = grip_of(at_once, oldest_ms=500)
    entries = {name: SensorEntry(baseline=replace(BASELINE, sensor=name)) for name in sensors}
    with Source(link, sensor_file=SensorFile(sensors=entries)) as source:
        grip.run(source, FakeModel(), 60)
    assert words in grip.why
    begun = ["close"] if len(sensors) == 1 else []
    assert done[: len(begun)] == begun and set(done[len(begun) :]) == {"stop"}


@pytest.mark.night
def test_an_object_of_ones_own_is_trained_on_and_run(empty, tmp_path):
    trimesh.creation.icosphere(radius=6, subdivisions=3).export(tmp_path / "ball.stl")
    (empty / "ball" / "work").mkdir(parents=True)
    (empty / "ball" / "work" / "plan.json").write_text('{"minutes": 4.0, "presses": 24, "steps": 2}')
    words = (tmp_path / "ball.stl", "--out", "ball", "--minutes", 4, "--figures", 0.5)
    code, out, errors = run(empty, "train_and_deploy.py", *words, timeout_s=280)
    assert code == 1, errors
    assert {path.name for path in empty.iterdir()} == {"ball"} and not (empty / "ball" / "ball.onnx").exists()
    assert any(line.startswith("this model | ") for line in out)
    assert out[0].startswith("ball.stl: 12 x 12 x 12 mm, taken as in mm")
    assert out[-1].startswith("not handed over: on presses of ball.stl it is ")
