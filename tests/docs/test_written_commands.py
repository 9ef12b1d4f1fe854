"""Commands, options and Python that README.md, docs/ and the Makefile give are what there is: they are run here.

What nobody sorted into PARSED or LEFT_OUT is run as it stands, against emulated sensors, and must succeed.
"""

import argparse
import importlib
import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from bridge_samples import write_recording
from doctor_samples import healthy_counts
from edge_samples import BASELINE, ROOT
from xela_server_emulator import ServerEmulator

from edge.cli import main as cli
from edge.inference.bundled import demo_recording, find_model
from edge.pipeline.gain_keeper import keep_learned
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.serial_ports import Port
from firmware_bridge.pad_geometry import CHANNELS
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import save_baselines

PAGES = (
    ROOT / "README.md",
    *sorted(page for page in (ROOT / "docs").glob("*.md") if page.stem not in ("decisions", "changelog")),
)
"""Pages whose commands must work; the others name commands and options as they were."""
_FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"(?<!`)`([^`\n]+(?:\n[^`\n]+)?)`(?!`)")
_OURS = re.compile(r"(?:edge-sr|make|pip install|python|mkdocs) \S")
NAMED = re.compile(r"edge-sr ([a-z]+)")
"""A command that is spoken of, not one to be typed."""
_MAKEFILE = re.compile(r"^\t(?:\w+=\S+ )*\$\(BIN\)/((?:python -m (?!pip|pytest)|edge-sr|mkdocs).*)$", re.MULTILINE)


def inline(page: Path) -> list[str]:
    """Return the texts between backticks."""
    return [" ".join(text.replace("\\|", "|").split()) for text in _INLINE.findall(_FENCE.sub("", page.read_text()))]


def commands() -> list[str]:
    """Return every command of ours in the pages, fenced, indented or between backticks, and in the Makefile once."""
    found = []
    for page in PAGES:
        fenced = False
        for line in page.read_text().replace("\\\n", " ").splitlines():
            fenced ^= line.lstrip().startswith("```")
            if (fenced or line.startswith("    ")) and _OURS.match(line.lstrip()):
                found.append(" ".join(re.sub(r"(?:^|\s)#.*", "", line).split()))
        spoken = [text for text in inline(page) if _OURS.match(text) and "..." not in text]
        found += [text for text in spoken if not NAMED.fullmatch(text)]
    made = _MAKEFILE.findall((ROOT / "Makefile").read_text())
    found += [command.replace("$(NETWORKS)", "mine/stsr.pt").replace("$@", "out.npz") for command in made]
    return list(dict.fromkeys(found))


COMMANDS = commands()
RATE_HZ = 500

PARSED = {
    r"edge-sr bench .*": "measures for minutes; test_bench runs it",
    r"edge-sr doctor --rehearse": "takes twenty seconds; test_doctor_command runs it",
    r"edge-sr models --measure": "measures run times for seconds; test_cli runs it",
    r"edge-sr --source demo:loop --sink ros2:.*": "goes on until it is ended; test_ros2 subscribes to its topics",
    r"edge-sr (replay \S+ )?--sink rerun:view": "opens a viewer; test_rerun sends to the package's interface",
    r"edge-sr map .*": "is of poses that a robot sends, and without them writes nothing; test_poses_stdin runs it",
    r"python -m (train|export)\..*": "trains, or needs what was trained; their own tests run them, shortened",
    r"python tests/system/chaos\.py .*": "takes minutes; test_chaos runs it, shortened",
    r"python tests/system/chaos_wire\.py .*": "plays until ended; test_chaos runs it",
    r"python tests/system/mutation_survey\.py.*": "takes an hour; test_chaos runs it on a part",
    r"python tests/system/program_cost\.py.*": "takes a minute; test_bench runs it, shortened",
    r"edge-sr (record |replay |--source replay:)FILE(\.\.\.)?( --view)?": "a name to be filled in; press.mcap is run",
    r"edge-sr replay --example --view": "waits for who looks; test_view_page_recordings looks at a recording",
}
LEFT_OUT = {
    r"pip install [\w'>=.-]+": "fetches what is of others",
    r"pip install -e \. \./examples/lerobot_camera_tactile_sr": "fetches LeRobot; test_lerobot imports the package",
    r"python examples/(print_force|stop_on_area|shm_read|zenoh_listen)\.py .*": "goes on; tests of their own run them",
    r"python examples/lerobot_camera_tactile_sr/observe\.py .*": "needs LeRobot; test_lerobot runs it",
    r"python examples/train_and_deploy\.py .*": "trains for minutes; test_examples runs it, shortened",
    r"python docs/live_pictures\.py": "pictures a browser for half a minute, which is looked at",
    r"mkdocs build .*": "test_architecture builds the site",
    r"python tests/docs/field_tables\.py": "writes the pages themselves; test_written_figures compares them",
}


def is_of(table: dict[str, str], command: str) -> bool:
    return not command.endswith(" --help") and any(re.fullmatch(pattern, command) for pattern in table)


RUN = [one for one in COMMANDS if not is_of(PARSED, one) and not is_of(LEFT_OUT, one)]
TYPED = [one for one in RUN if one.startswith("edge-sr ")]


@pytest.fixture
def only_parsed(monkeypatch):
    """Programs that end where they have understood their arguments."""
    parse = argparse.ArgumentParser.parse_args

    def parse_args(self, args=None, namespace=None):
        parse(self, args, namespace)
        sys.exit("understood")

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_args)


def entry(words: list[str]):
    """Main function and arguments of a command of this repository."""
    if words[0] == "edge-sr":
        return cli.main, words[1:]
    assert words[0] == "python", f"{words[0]}: who runs this?"
    if words[1] == "-m":
        package = hasattr(importlib.import_module(words[2]), "__path__")
        return importlib.import_module(f"{words[2]}.__main__" if package else words[2]).main, words[3:]
    assert Path(words[1]).parts[0] == "tests", f"{words[1]}: who runs this?"
    return importlib.import_module(Path(words[1]).stem).main, words[2:]


@pytest.fixture(scope="module")
def emulated():
    """Two adapters of a sensor each, and the vendor's server."""
    free = Recording(Path("free.csv"), (Track("4", healthy_counts(200), None),), float(RATE_HZ))
    with (
        Emulator([free], loop=True, frame_s=1e-6) as left,
        Emulator([free], loop=True, frame_s=1e-6) as right,
        ServerEmulator([free], loop=True, message_hz=200) as server,
    ):
        yield left, right, server


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    """Recordings of the demo's taps as press.npz and press.mcap."""
    folder = tmp_path_factory.mktemp("press")
    words = ["replay", str(demo_recording()), "--duration-s", "4.6"]
    assert cli.main([*words, "--sink", f"mcap:{folder}/press.mcap"]) == 0
    assert cli.main(["convert", f"{folder}/press.mcap", f"{folder}/press.npz"]) == 0
    return folder


@pytest.fixture
def world(emulated, press, tmp_path, plugged, monkeypatch):
    """Folder with what the pages take for granted, and adapters at the places that they name."""
    left, right, server = emulated
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    shutil.copy(press / "press.npz", "press.npz")
    for name in ("left", "right", "released", "held"):
        write_recording(tmp_path / f"{name}.csv", healthy_counts(150))
    save_baselines("zero.json", [BASELINE.of("4", healthy_counts(1)[0], 1000.0, 100, "file")])
    save_sensor_file("sensor.toml", SensorFile(sensors={"4": SensorEntry(assumed=frozenset({"mounting"}))}))
    (tmp_path / "mine").mkdir()
    for name in ("stsr", "mine"):
        shutil.copy(find_model("stsr"), f"mine/{name}.onnx")

    def prepare(command: str) -> list[str]:
        plugged.append(Port(left.port, (0x0403, 0x6015), "D30BL366", "VScom USB-CAN Plus"))
        if "D30BL401" in command:
            plugged.append(Port(right.port, (0x0403, 0x6015), "D30BL401", "VScom USB-CAN Plus"))
        if "press.mcap" in command and " record " not in command and "mcap:press.mcap" not in command:
            shutil.copy(press / "press.mcap", "press.mcap")
        if " doctor " in command and "--out" in command and "--sensor" not in command:
            Path("sensor.toml").unlink()
        if "--forget-gains" in command:
            keep_learned(Path("sensor.toml"), "4", Pad(gains=(1.0,) * CHANNELS))
        if " convert " in command:
            Path("press.npz").rename("old.npz")
        for written, real in (
            ("/dev/ttyUSB0", left.port),
            ("/tmp/skin", left.port),
            ("ws://192.168.0.21", server.url),
            ("tcp/10.0.0.5", "tcp/127.0.0.1"),
            ("shm:skin", f"shm:skin-{os.getpid()}"),
        ):
            command = command.replace(written, real)
        return [] if "\n" in command else shlex.split(command.partition(" | ")[0])

    return prepare


def shortened(words: list[str]) -> list[str]:
    """The same for less long, at a port that is free."""
    if "--view" in words:
        at = words.index("--view") + 1
        words = [*words[:at], "0", *words[at + (words[at : at + 1] != [] and words[at].isdigit()) :]]
    if words[1] == "doctor":
        return [*words, "--drift-s", "0.5"]
    if words[1] in ("baseline", "models", "devices", "bench", "convert"):
        return words
    if "--view" in words or not ("replay" in words or "demo" in words or any("replay:" in word for word in words)):
        words = [*words, "--duration-s", "1"]  # the others end by themselves
    if "demo" in words or any(word.startswith("replay:") for word in words):
        words = [*words, "--rate-hz", str(RATE_HZ)]
    return words


@pytest.mark.parametrize("command", TYPED)
def test_edge_sr_does_what_is_typed(command, world, capfd):
    words = shortened(world(command))
    code = cli.main(words[1:])
    out, err = capfd.readouterr()
    assert code in ((0, 1) if words[1] == "doctor" else (0,)), err
    if "jsonl:-" in words:
        states = [json.loads(line)["state"] for line in out.splitlines()]
        assert states and set(states) <= {"zeroing", "incomplete", "idle", "contact", "dropped", "event"}
    for written in (word.rpartition(":")[2] for word in words if word.endswith((".npz", ".toml", ".json"))):
        assert Path(written).is_file(), written
    assert out or err


@pytest.mark.parametrize("command", [one for one in RUN if one.startswith("python ")])
def test_programs_run(command, world, argv, capfd):
    words = world(command)
    if words[1].startswith("docs/"):  # such a program writes next to itself
        Path("docs").mkdir()
        shutil.copy(ROOT / words[1], words[1])
        argv(words[1:])
        runpy.run_path(str(Path(words[1]).resolve()), run_name="__main__")
        assert {path.suffix for path in Path("docs").iterdir()} > {".py"}
        return
    main, arguments = entry(words)
    try:
        code = main(arguments)
    except SystemExit as left:
        code = left.code
    assert code in (0, None), capfd.readouterr().err


@pytest.mark.parametrize("command", [one for one in COMMANDS if is_of(PARSED, one)])
def test_what_takes_long_is_understood(command, only_parsed):
    main, arguments = entry(shlex.split(command))
    with pytest.raises(SystemExit, match="understood"):
        main(arguments)


@pytest.mark.parametrize("command", [one for one in RUN if one.startswith("make ")])
def test_make_knows_the_target(command):
    told = subprocess.run(["make", "--dry-run", *command.split()[1:]], cwd=ROOT, capture_output=True, text=True)
    assert told.returncode == 0 and "$(" not in told.stdout, told.stderr


@pytest.mark.parametrize("command", [one for one in RUN if one.startswith("pip install ")])
def test_extras_that_are_to_be_installed_are_declared(command):
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    asked = re.search(r"\[([\w,-]+)\]", command)
    assert asked and set(asked[1].split(",")) <= set(declared)


def test_commands_that_are_spoken_of_exist():
    spoken = {match[1] for page in PAGES for text in inline(page) if (match := NAMED.fullmatch(text))}
    assert spoken >= {"doctor"} and spoken <= set(cli.COMMANDS)


def test_options_that_are_spoken_of_exist():
    known = {
        option
        for package in ("edge", "examples", "export", "firmware_bridge", "tests/system", "train")
        for path in (ROOT / package).rglob("*.py")
        for option in re.findall(r'"(--[a-z][a-z0-9-]*)[ "]', path.read_text())
    }
    spoken = " ".join(text for page in PAGES for text in inline(page))
    assert set(re.findall(r"(?<!\S)(--[a-z][a-z0-9-]*)", spoken)) <= known | {"--help"}


def test_every_option_is_spoken_of():
    spoken = {option for page in PAGES for option in re.findall(r"--[a-z][a-z0-9-]*", page.read_text())}
    for command in ("", *cli.COMMANDS):
        options = set(re.findall(r"^ *(--[a-z][a-z0-9-]*)", cli.parser(command).format_help(), re.MULTILINE))
        assert options - {"--version"} <= spoken, f"edge-sr {command}: {options - spoken}"  # this is as anywhere


@pytest.mark.parametrize(
    "snippet",
    [
        pytest.param(text.replace(f"\n{indent}", "\n").removeprefix(indent), id=f"{page.name}-{at}")
        for page in PAGES
        if page.name != "recipes.md"  # which test_recipes runs
        for at, (indent, language, text) in enumerate(_FENCE.findall(page.read_text()))
        if language == "python"
    ],
)
def test_python_of_the_pages_runs(snippet, world):
    world(snippet)
    exec(compile(snippet, "snippet", "exec"), {"__name__": "snippet"})
