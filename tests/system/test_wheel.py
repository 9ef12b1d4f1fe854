"""The wheel alone, in an environment that holds nothing else."""

import json
import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OURS = ("edge", "export", "firmware_bridge", "train")
NOT_IN_THE_RUNTIME = {"torch", "onnx", "onnxscript", "trimesh", "scipy", "shapely"}


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """bin folder of a new environment with the wheel and what it asks for."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    environment = {"PIP_CONSTRAINT": str(ROOT / "constraints.txt")}
    run([*pip, "wheel", "--no-deps", "--wheel-dir", str(folder), str(ROOT)], **environment)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "env", with_pip=True)
    run([str(folder / "env/bin/python"), *pip[1:], "install", str(wheel)], **environment)
    return folder / "env" / "bin"


def run(command, **environment):
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, env={**os.environ, **environment})
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_runtime_installs_without_the_training_libraries(fresh):
    installed = json.loads(run([str(fresh / "python"), "-m", "pip", "list", "--format", "json"]))
    assert not NOT_IN_THE_RUNTIME & {package["name"].lower() for package in installed}


def test_the_demo_runs_from_the_wheel(fresh, tmp_path):
    records = tmp_path / "records.jsonl"
    out = run([str(fresh / "edge-sr"), "--source", "demo", "--sink", f"jsonl:{records}"])
    assert "PSNR" in out
    lines = [json.loads(line) for line in records.read_text().splitlines()]
    assert {line["source"] for line in lines} == {"emulated"}
    assert max(line["taps_used"] or 0 for line in lines) == 4
    assert any(line["pattern"] for line in lines)


def test_a_users_type_checker_may_look_into_every_package(fresh):
    (packages,) = fresh.parent.glob("lib/python*/site-packages")
    assert sorted(path.parent.name for path in packages.glob("*/py.typed") if path.parent.name in OURS) == sorted(OURS)


def test_the_models_are_in_the_wheel(fresh):
    out = run([str(fresh / "edge-sr"), "models"])
    assert all(name in out for name in ("stsr", "mtsr2", "mtsr4"))
