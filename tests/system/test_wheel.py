"""The wheel alone, in an environment that holds nothing else."""

import json
import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OURS = {"edge", "firmware_bridge", "train", "export"}
IN_THE_WHEEL = {"edge", "firmware_bridge"}
NOT_IN_THE_RUNTIME = {"torch", "onnx", "onnxscript", "trimesh", "scipy", "shapely"}


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """Folder bin of a new environment with the wheel and its dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    environment = {"PIP_CONSTRAINT": str(ROOT / "constraints.txt")}
    run([*pip, "wheel", "--no-deps", "--wheel-dir", str(folder), str(ROOT)], **environment)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "env", with_pip=True)
    run([str(folder / "env/bin/python"), *pip[1:], "install", str(wheel)], **environment)
    return folder / "env" / "bin"


def run(command, **environment):
    # Without PYTHONPATH: a checkout on it would lend what the wheel lacks.
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, env={**inherited, **environment})
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


def test_it_holds_the_runtime_alone_and_tells_a_users_type_checker(fresh):
    (packages,) = fresh.parent.glob("lib/python*/site-packages")
    assert {path.name for path in packages.iterdir()} & OURS == IN_THE_WHEEL
    assert {path.parent.name for path in packages.glob("*/py.typed") if path.parent.name in OURS} == IN_THE_WHEEL
    assert not (packages / "edge" / "bench").exists()
    assert {path.name for path in (packages / "edge" / "models").iterdir()} == {
        *("mtsr2-int8.onnx", "mtsr4-int8.onnx", "stsr-int8.onnx", "stsr-small-int8.onnx"),
        *("contacts.npz", "demo.npz", "grips.npz", "taxels.npz"),
    }


def test_every_module_of_it_can_be_imported_without_what_is_left_out(fresh, tmp_path):
    program = """
import importlib, pkgutil, edge, firmware_bridge
names = [one.name for package in (edge, firmware_bridge)
         for one in pkgutil.walk_packages(package.__path__, package.__name__ + ".", onerror=lambda name: None)]
extras = {"can", "zenoh", "cyclonedds"}
for name in names:
    if not name.endswith("__main__"):
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name not in extras:
                raise
print(len(names))
"""
    (tmp_path / "every.py").write_text(program)
    assert int(run([str(fresh / "python"), "-I", str(tmp_path / "every.py")])) > 100


@pytest.mark.parametrize(
    ("arguments", "code", "line"),
    [
        (
            ["--source", "demo", "--model", "stsr"],
            4,
            "edge-sr: model 'stsr' is in float32, which this installation lacks: take stsr-int8, or install a checkout "
            "(pip install --editable .), which has all models",
        ),
        (
            ["bench"],
            2,
            "edge-sr: the wheel leaves edge-sr bench out: install a checkout (pip install --editable '.[bench]')",
        ),
    ],
)
def test_what_is_left_out_is_one_line(fresh, tmp_path, arguments, code, line):
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(fresh / "edge-sr"), *arguments],
        cwd=tmp_path,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout, done.stderr.splitlines()) == (code, "", [line])


def test_the_models_are_in_the_wheel(fresh):
    out = run([str(fresh / "edge-sr"), "models"])
    assert all(name in out for name in ("stsr", "mtsr2", "mtsr4"))
