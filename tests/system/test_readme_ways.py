"""README's two commands and six ways, typed literally in a bare clone and empty environments, as a new user does.

They fetch gigabytes: `pytest -m night -s tests/system/test_readme_ways.py` prints how long each line took.
"""

import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import trimesh
from edge_samples import ROOT

ENDLESS = {
    "make run": "http://127.0.0.1",
    "edge-sr demo --view": "http://127.0.0.1",
    "edge-sr replay --example --view": "http://127.0.0.1",
    "edge-sr --source demo:loop --sink ros2:skin": "an emulated sensor taps",
}
"""Commands that go on until Ctrl-C, and what they print once they are at work."""
LONGEST_S = 1800


def typed() -> list[str]:
    """Lines of README's shell blocks up to the real sensor, without comments."""
    page = (ROOT / "README.md").read_text().partition("## A real sensor")[0]
    lines = "\n".join(re.findall(r"```sh\n(.*?)```", page, re.DOTALL)).splitlines()
    return [line for text in lines if (line := text.partition("  #")[0].strip())]


def run(folder: Path, command: str, at_work: str | None = None) -> str:
    """Run a command until it ends, or until it is at work and Ctrl-C; return what it printed."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(
        ["bash", "-c", command], cwd=folder, env=variables, start_new_session=True, text=True, **pipes
    ) as process:
        try:
            shown = "".join(_until(process.stdout, at_work))
            if at_work is not None:
                assert at_work in shown, f"{command} ended: {shown[-2000:]}"
                time.sleep(3)
                os.killpg(process.pid, signal.SIGINT)
            rest, _ = process.communicate(timeout=LONGEST_S)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    allowed = {0} if at_work is None else {0, 130, -signal.SIGINT}
    assert process.returncode in allowed, f"{command}: {(shown + rest)[-2000:]}"
    return shown + rest


def _until(lines, at_work: str | None) -> Iterator[str]:
    for line in lines if at_work is not None else ():
        yield line
        if at_work in line:
            return


@pytest.mark.night
@pytest.mark.timeout(2 * LONGEST_S)
def test_what_readme_types_works(tmp_path):
    clone, *lines = typed()
    assert clone == "git clone URL tactile && cd tactile" and len([line for line in lines if "edge-sr" in line]) >= 3
    subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", ROOT, tmp_path / "tactile"], check=True)
    folder, activated = tmp_path / "tactile", ":"
    bolt = trimesh.creation.cylinder(radius=3.0, height=12.0) + trimesh.creation.cylinder(radius=5.0, height=3.0)
    bolt.export(folder / "bolt.stl")
    for line in lines:
        begun_s = time.monotonic()
        trains = "train_and_deploy.py" in line  # four minutes of it hand no model over, which is a 1
        shown = run(folder, f"{activated} && {line}{'; test $? -le 1' if trains else ''}", ENDLESS.get(line))
        assert not trains or "not handed over: " in shown or "from now on: " in shown
        if re.search(r"(^|&& )\. \S+/activate$", line):
            activated = f". {line.rpartition('. ')[2]}"
        print(f"{time.monotonic() - begun_s:6.1f} s  {line}")
        assert "Traceback" not in shown, f"{line}: {shown[-2000:]}"
