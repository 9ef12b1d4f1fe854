"""The runtime works with what its wheel holds alone, and says in one line how to get the rest."""

import os
import shutil
import subprocess
import sys
import tomllib

import pytest
from edge_samples import ROOT
from pathspec import GitIgnoreSpec  # as hatchling reads its exclusions

BUILD = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Folder of what is in the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    left_out = GitIgnoreSpec.from_lines(BUILD["exclude"])
    for package in BUILD["packages"]:
        for path in (ROOT / package).rglob("*"):
            name = path.relative_to(ROOT)
            if path.is_file() and path.suffix != ".pyc" and not left_out.match_file(name):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, folder / name)
    return folder


def edge_sr(wheel, *arguments):
    # -S: an editable installation of the checkout would lend what is missing; its libraries are given by name.
    libraries = os.pathsep.join([str(wheel), *(path for path in sys.path if path.endswith("site-packages"))])
    return subprocess.run(
        [sys.executable, "-S", "-m", "edge", *arguments],
        cwd=wheel,
        env={**os.environ, "PYTHONPATH": libraries},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_it_leaves_out_training_export_bench_the_emulated_server_and_float32(wheel):
    assert {path.name for path in wheel.iterdir()} == {"edge", "firmware_bridge"}
    assert not (wheel / "edge" / "bench").exists()
    assert not list((wheel / "firmware_bridge" / "emulation").glob("*server*"))
    models = {path.name for path in (wheel / "edge" / "models").iterdir()}
    assert models == {
        *("mtsr2-int8.onnx", "mtsr4-int8.onnx", "stsr-int8.onnx", "stsr-small-int8.onnx"),
        *("demo.npz", "taxels.npz"),
    }


def test_the_demo_scores_its_taps(wheel):
    done = edge_sr(wheel, "demo")
    assert done.returncode == 0, done.stderr
    assert "taps scored at their peak, against the known truth" in done.stdout


def test_every_module_of_it_can_be_imported_without_what_is_left_out(wheel):
    names = [".".join(path.relative_to(wheel).with_suffix("").parts) for path in wheel.rglob("*.py")]
    names = [name for name in names if not name.endswith(("__init__", "__main__"))]
    program = "import importlib, sys\nfor name in sys.argv[1:]:\n    importlib.import_module(name)"
    libraries = os.pathsep.join([str(wheel), *(path for path in sys.path if path.endswith("site-packages"))])
    done = subprocess.run(
        [sys.executable, "-S", "-c", program, *(name for name in names if "ros2" not in name)],
        cwd=wheel,
        env={**os.environ, "PYTHONPATH": libraries},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr


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
def test_what_is_left_out_is_one_line(wheel, arguments, code, line):
    done = edge_sr(wheel, *arguments)
    assert (done.returncode, done.stdout, done.stderr.splitlines()[-1]) == (code, "", line)
    assert "Traceback" not in done.stderr
