"""Traces that a run leaves of onnxruntime, which sends telemetry unless it is switched off."""

import os
import subprocess
import sys

from edge_samples import ROOT, make_contract, write_model

RUN = """
import os, sys
from pathlib import Path
from edge.inference.onnx_session import ModelSession
ModelSession(Path(sys.argv[1]))
print(os.environ.get("ORT_DISABLE_TELEMETRY"), *sorted(os.listdir("/proc/self/fd")), sep=",")
print(*[path for path in Path.home().rglob("*")], sep=",")
"""


def test_a_session_writes_nothing_into_the_home_folder_and_opens_nothing(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    model = write_model(tmp_path / "tiny.onnx", make_contract())
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(model)],
        env=environment | {"HOME": str(home), "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    disabled, *descriptors = done.stdout.splitlines()[0].split(",")
    assert disabled == "1"
    assert len(descriptors) == 4, "more than the standard three and that of the listing"
    assert done.stdout.splitlines()[1] == "" and done.stderr == ""
