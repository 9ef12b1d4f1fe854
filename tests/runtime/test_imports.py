"""Modules that the runtime really loads, in a process of its own."""

import ast
import os
import subprocess
import sys
from importlib.util import find_spec

from bridge_samples import make_counts, write_recording
from edge_samples import ROOT

FORBIDDEN = {"torch", "onnx", "trimesh", "scipy", "shapely", "skimage", "pytest", "hypothesis"}


def loaded(*modules: str) -> set[str]:
    script = f"import sys, {', '.join(modules)}; print(*sys.modules, sep='\\n')"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120
    )
    return {name.partition(".")[0] for name in done.stdout.split()}


def test_the_runtime_loads_no_training_library():
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("edge", "firmware_bridge")
        for path in sorted((ROOT / package).rglob("*.py"))
        if path.stem != "__init__" and (find_spec("cyclonedds") or "ros2" not in path.parts)
    ]
    assert {
        "edge.cli.main",
        "edge.inference.onnx_session",
        "edge.cli.demo_score",
        "firmware_bridge.emulation.robot_main",
    } <= set(modules)
    assert not loaded(*modules) & FORBIDDEN


def test_contract_and_cli_load_no_onnxruntime():
    assert "onnxruntime" not in loaded(
        "edge.inference.contract",
        "edge.api",
        "edge.cli.main",
        "edge.perception.runtime",
        "edge.pipeline.pump",
        "edge.sinks.registry",
    )


UNUSED_IN_A_REPLAY = {
    "edge.sinks.jsonl",
    "edge.sinks.npz_file",
    "edge.sinks.ros2.sink",
    "cyclonedds",
    "tqdm",
    "edge.bench",
    "edge.cli.demo_score",
    "edge.terminal.heatmap",
    "edge.cli.realtime",
    "firmware_bridge.emulation.robot_main",
    "firmware_bridge.emulation.slcan_emulator",
    "firmware_bridge.links.demo",
    "firmware_bridge.links.slcan_serial",
    "firmware_bridge.links.xela_server",
    "websockets",
    "firmware_bridge.links.gs_usb_link",
    "firmware_bridge.links.can_bus",
    "usb",
    "can",
    "subprocess",
}
RUN = """
import sys, threading
from edge.cli import main as cli
from edge.pipeline import scan_reader as source
within = []
taken = source.Source.take
source.Source.take = lambda *a: within.append([t.name for t in threading.enumerate()]) or taken(*a)
code = cli.main(["--source", "replay:" + sys.argv[1], "--rate-hz", "1000", "--sink", "status"])
print(code, within[0], sorted(sys.modules), sep="\\n")
"""


def test_a_run_loads_what_it_uses_and_starts_two_threads(tmp_path):
    """One reads, for as long as scans come; one sleeps until a signal asks for the end."""
    write_recording(tmp_path / "rest.csv", make_counts(1000))
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(tmp_path / "rest.csv")],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
    )
    code, threads, modules = done.stdout.splitlines()
    assert code == "0", done.stderr
    assert ast.literal_eval(threads) == ["MainThread", "ending", "scan-reader"]
    assert not set(ast.literal_eval(modules)) & (UNUSED_IN_A_REPLAY | FORBIDDEN)
    assert "edge.sinks.status_line" in ast.literal_eval(modules)


MOST_MODULES = 145
"""Modules of ours that a run of the demo with a file of records loads: each is work for a reader, and for a start."""
COUNTED = """
import sys
from edge.cli.main import main
code = main(["--source", "demo", "--duration-s", "1", "--sink", "jsonl:" + sys.argv[1]])
print(code, *(name for name in sorted(sys.modules) if name.partition(".")[0] in ("edge", "firmware_bridge")))
"""


def test_the_demo_loads_few_modules(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", COUNTED, str(tmp_path / "out.jsonl")],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
    )
    code, *modules = done.stdout.split("\n")[-2].split()
    assert code == "0", done.stderr
    assert 50 < len(modules) <= MOST_MODULES, modules
