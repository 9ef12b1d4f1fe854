"""Errors where an extra is not installed: from the sources, from a wheel, and by the commands that need one."""

import importlib.metadata
import subprocess
import sys

import pytest
from edge_samples import ROOT

from firmware_bridge import extras
from firmware_bridge.extras import how_to_install, need

NOTHING_INSTALLED = [sys.executable, "-S"]


def test_from_the_sources_their_folder_is_named():
    assert how_to_install("zenoh") == f"pip install '{ROOT}[zenoh]'"


@pytest.mark.parametrize(
    ("extra", "wanted"),
    [("one", "'b>=2'"), ("two", "'c>=3' 'd'"), ("both", "'b>=2' 'c>=3' 'd' 'e'"), ("none", "'tactile-edge-sr[none]'")],
)
def test_from_a_wheel_the_packages_are(monkeypatch, tmp_path, extra, wanted):
    required = [
        *("a>=1", "b>=2; extra == 'one'", "c>=3 ; extra == 'two'", 'd; sys_platform == "linux" and extra == "two"'),
        *("tactile-edge-sr[one,two]; extra == 'both'", "e; extra == 'both'"),
    ]
    monkeypatch.setattr(extras, "_FOLDER", tmp_path)
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: required)
    assert how_to_install(extra) == f"pip install {wanted}"


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
