"""A run in a process of its own: what it loads, starts and leaves; and errors where an extra is not installed."""

import ast
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec

import pytest
from bridge_samples import make_counts, write_recording
from edge_samples import ROOT

from firmware_bridge.errors import how_to_install, need

FORBIDDEN = {"torch", "onnx", "trimesh", "scipy", "shapely", "skimage", "pytest", "hypothesis"}
UNUSED_IN_A_REPLAY = {
    *("edge.bench", "edge.cli.demo", "edge.sinks.json_records", "edge.sinks.converted_files", "edge.sinks.ros2.sink"),
    *("cyclonedds", "tqdm", "websockets", "usb", "can", "subprocess", "firmware_bridge.emulation.slcan_emulator"),
    *(f"firmware_bridge.links.{name}" for name in ("demo", "slcan_serial", "xela_server", "gs_usb_link", "can_bus")),
}
MOST_MODULES = 101
"""Modules of ours that a run loads: each is work for a reader, and for a start."""


def run(code, *arguments, **environment):
    command = [sys.executable, "-c", code, *map(str, arguments)]
    settings = {"stdin": subprocess.DEVNULL, "capture_output": True, "text": True, "timeout": 120, "check": True}
    return subprocess.run(command, cwd=ROOT, env=os.environ | environment, **settings).stdout.splitlines()


def test_no_module_of_the_runtime_loads_a_training_library():
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("edge", "firmware_bridge")
        for path in sorted((ROOT / package).rglob("*.py"))
        if path.stem != "__init__" and (find_spec("cyclonedds") or "ros2" not in path.parts)
    ]
    assert {"edge.cli.main", "edge.inference.onnx_session", "firmware_bridge.links.demo"} <= set(modules)
    light = "edge.inference.contract", "edge.api", "edge.cli.main", "edge.pipeline.result_stream", "edge.sinks.registry"
    first, every = run(
        f"import sys, {', '.join(light)}\nprint(*sys.modules)\nimport {', '.join(modules)}\nprint(*sys.modules)"
    )
    assert "onnxruntime" not in first.split()
    assert not {name.partition(".")[0] for name in every.split()} & FORBIDDEN


RUN = """
import os, sys, threading
from pathlib import Path
from edge.cli import main as cli
from edge.pipeline import scan_reader as source
within = []
taken = source.Source.take
source.Source.take = lambda *a: within.append([t.name for t in threading.enumerate()]) or taken(*a)
code = cli.main(["--source", "replay:" + sys.argv[1], "--rate-hz", "1000", "--sink", "status"])
home = [str(path) for path in Path.home().rglob("*")]
print(code, within[0], sorted(sys.modules), os.environ.get("ORT_DISABLE_TELEMETRY"), home, sep="\\n")
print("libcrypto" in open("/proc/self/maps").read() if os.path.exists("/proc/self/maps") else False)
"""


def test_a_run_loads_what_it_uses_and_leaves_no_trace(tmp_path):
    """One thread reads, for as long as scans come; one sleeps until a signal asks for the end.

    onnxruntime sends telemetry unless it is switched off.
    """
    home = tmp_path / "home"
    home.mkdir()
    write_recording(tmp_path / "rest.csv", make_counts(2000))  # the reader still reads when a loaded machine looks
    code, threads, modules, disabled, left, with_openssl = run(RUN, tmp_path / "rest.csv", HOME=str(home))[-6:]
    assert code == "0" and ast.literal_eval(threads) == ["MainThread", "ending", "scan-reader"]
    loaded = set(ast.literal_eval(modules))
    assert "edge.sinks.status_line" in loaded and not loaded & (UNUSED_IN_A_REPLAY | FORBIDDEN)
    ours = [name for name in loaded if name.partition(".")[0] in ("edge", "firmware_bridge")]
    assert 50 < len(ours) <= MOST_MODULES, sorted(ours)
    assert (disabled, left, with_openssl) == ("1", "[]", "False")


NOTHING_INSTALLED = [sys.executable, "-E", "-S"]


def test_the_sources_name_their_folder_and_a_wheel_its_name(tmp_path):
    assert how_to_install("zenoh") == f"pip install '{ROOT}[zenoh]'"
    (tmp_path / "firmware_bridge").mkdir()
    shutil.copy(ROOT / "firmware_bridge/errors.py", tmp_path / "firmware_bridge")
    script = "from firmware_bridge.errors import how_to_install\nprint(how_to_install('zenoh'))"
    told = subprocess.run([*NOTHING_INSTALLED, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert told.stdout == "pip install 'tactile-edge-sr[zenoh]'\n"


@pytest.mark.parametrize("command", ["train.fit", "export.to_onnx"])
def test_a_command_without_its_libraries_ends_in_one_line(command):
    done = subprocess.run([*NOTHING_INSTALLED, "-m", command], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("not installed: torch, ") and done.stderr.count("\n") == 1
    assert done.stderr.endswith(f"; pip install '{ROOT}[{command.partition('.')[0]}]'\n")


def test_a_program_gets_an_error_it_can_catch():
    need("train", "json")
    with pytest.raises(ModuleNotFoundError, match=r"^not installed: no_such_module; pip install ") as missing:
        need("train", "json", "no_such_module")
    assert missing.value.name == "no_such_module"
