"""Files for ROS's own programs, held against what the sink publishes and the command takes."""

import shlex
import xml.etree.ElementTree as ElementTree

import pytest
import yaml

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

from edge_samples import ROOT, make_wrench_result
from ros2_samples import sink

from edge.cli.run_options import parser
from edge.sinks.registry import check_sink

__all__ = ["sink"]
FILES = ROOT / "examples/ros2"


def test_the_launch_file_starts_a_command_that_edge_sr_takes():
    launch = ElementTree.parse(FILES / "skin.launch.xml").getroot()
    values = {one.get("name"): one.get("default") for one in launch.iter("arg")}
    (executable,) = launch.iter("executable")
    command = executable.get("cmd")
    for name, value in (values | {"options": "--sensor s.toml"}).items():
        command = command.replace(f"$(var {name})", value)
    assert "$(" not in command and values["options"] == ""
    program, *words = shlex.split(command)
    options = parser().parse_args(words)
    assert (program, str(options.sensor)) == ("edge-sr", "s.toml")
    assert [check_sink(one) for one in options.sink] == [("ros2", "skin?commands")]
    (node,) = launch.iter("node")
    assert (FILES / node.get("args").removeprefix("-d $(dirname)/")).is_file()


def test_rviz_shows_topics_that_are_published(sink):
    shown = yaml.safe_load((FILES / "skin.rviz").read_text())["Visualization Manager"]
    published = set()
    sink._publish = lambda writer, message: published.add(writer.topic.name.removeprefix("rt"))
    sink._is_read = lambda writer: True
    result = make_wrench_result()
    sink.write(result, {})
    sink.close()  # which withdraws the points
    topics = {one["Topic"]["Value"] for one in shown["Displays"] if "Topic" in one}
    assert topics == {"/skin/s4/points", "/skin/s4/wrench", "/skin/s4/pattern"} and topics <= published
    assert shown["Global Options"]["Fixed Frame"] == result.scan.sensor
    qos = yaml.safe_load((FILES / "play_qos.yaml").read_text())["/tf_static"]
    assert (qos["durability"], qos["reliability"]) == ("transient_local", "reliable")
