"""README's six ways to begin, played by the command that README gives; training is shortened."""

import importlib.util
import os
import re
import runpy
import shlex
import signal
import subprocess
import sys

import lerobot_stand_in
import pytest
import written_samples
from edge_samples import ROOT, ended
from view_samples import TIMEOUT_S, unpack
from websockets.sync.client import connect

from edge.inference.bundled import demo_recording

WAYS = next(
    block for block in written_samples.blocks() if "stop_on_area.py" in block.text and block.page == "README.md"
)


def written(begins):
    """Return the words of the command of README's block that begins so."""
    (line,) = [line for line in WAYS.text.splitlines() if line.startswith(begins)]
    return shlex.split(line, comments=True)


def start(words, **environment):
    words = [sys.executable, "-m", "edge", *words[1:]] if words[0] == "edge-sr" else [sys.executable, *words[1:]]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return ended(subprocess.Popen(words, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)} | environment, **pipes))


@pytest.mark.parametrize("begins", ["edge-sr demo", "edge-sr replay"])
def test_a_pattern_is_on_the_page(begins):
    words = [str(demo_recording()) if word == "FILE..." else word for word in written(begins)]
    assert words[-1] == "--view"
    with start([*words, "0"]) as run:
        url = next(line for line in run.stderr if line.startswith("live page: ")).split()[2]
        with connect(f"ws{url[4:]}ws", max_queue=None, max_size=None) as viewer:
            while True:
                header, maps = unpack(viewer.recv(TIMEOUT_S))
                if header["kind"] == "result" and "pattern" in maps:
                    break
        assert maps["pattern"].max() > 0.02
        run.send_signal(signal.SIGINT)
        run.communicate(timeout=TIMEOUT_S)
        assert run.returncode == 0


def test_lerobot_observes(monkeypatch, capsys):
    if importlib.util.find_spec("lerobot") is None:
        lerobot_stand_in.install(monkeypatch)
    monkeypatch.syspath_prepend(ROOT / "examples/lerobot_camera_tactile_sr/src")
    words = written("python examples/lerobot_camera_tactile_sr/observe.py")
    monkeypatch.setattr(sys, "argv", words[1:])
    try:
        runpy.run_path(str(ROOT / words[1]), run_name="__main__")
    finally:
        for name in [name for name in sys.modules if name.startswith("lerobot_camera_tactile_sr")]:
            del sys.modules[name]
    image = r"observation\.images\.tactile: \(40, 40, 3\) uint8, .*"
    assert re.match(image + r"\nobservation\.state: \d+ numbers, .*", capsys.readouterr().out)


def test_a_ros_node_reads_a_topic():
    """Its types are made of ROS's own definitions."""
    pytest.importorskip("cyclonedds", reason="of the extra `ros2`")
    from ros2_samples import ENVIRONMENT, Listener

    topic = "skin/s4/area_m2"
    assert f"/{topic}" in WAYS.text
    with start(written("edge-sr --source demo:loop"), **ENVIRONMENT), Listener({topic: "std_msgs/msg/Float64"}) as node:
        node.until(lambda: any(message["data"] > 1e-5 for message in node.of(topic)))
