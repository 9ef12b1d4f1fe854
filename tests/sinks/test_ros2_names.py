"""Names of ROS 2 topics, and environments that cannot be used."""

import re
import subprocess
import sys

import pytest

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

from edge_samples import ROOT
from hypothesis import given
from hypothesis import strategies as st

from edge.errors import SinkError, UsageError
from edge.sinks.ros2.sink import Ros2Sink
from edge.sinks.ros2.topic_names import LONGEST_TOPIC, base_topic, sensor_topic

ROS_TOPIC = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
NAMES = st.text(st.sampled_from("s4x_/é a0Z"), min_size=1, max_size=8)


@given(NAMES, NAMES)
def test_every_sensor_has_topics_of_its_own_that_ros_can_hold(one, other):
    topics = [sensor_topic("skin", name, "pattern") for name in (one, other)]
    assert all(map(ROS_TOPIC.fullmatch, topics)) and "__" not in "".join(topics)
    assert (topics[0] == topics[1]) == (one == other)


@pytest.mark.parametrize(
    ("sensor", "topic"),
    [("4", "s4"), ("left/4", "left/s4"), ("left_1", "left_1"), ("s4", "x_7334"), ("x_1", "x_785f31"), ("/", "x_0/x_0")],
)
def test_sensors_names_as_topics(sensor, topic):
    assert sensor_topic("skin", sensor, "pattern") == f"skin/{topic}/pattern"


def test_names_that_ros_cannot_hold_are_refused():
    assert base_topic("/gripper/skin_1") == "gripper/skin_1"
    with pytest.raises(SinkError, match=rf"ROS holds {LONGEST_TOPIC - 1}: name sensor"):
        sensor_topic("skin", "ä" * 64, "pattern")


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"ROS_DOMAIN_ID": "-1"}, r"ROS_DOMAIN_ID is '-1', expected a whole number from 0 to 232"),
        ({"ROS_DOMAIN_ID": "233"}, r"ROS_DOMAIN_ID is '233'"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "off"}, r"is OFF, which hides edge-sr from other nodes"),
    ],
)
def test_an_environment_that_ros_would_not_take_is_refused(environment, said):
    with pytest.raises(UsageError, match=said):
        Ros2Sink("skin", environment)


def test_a_configuration_that_is_none_is_told(capfd):
    with pytest.raises(SinkError, match=r"cannot join DDS domain 7 .*CYCLONEDDS_URI"):
        Ros2Sink(
            "skin", {"ROS_DOMAIN_ID": "7", "CYCLONEDDS_URI": "<CycloneDDS><Domain><Nonsense/></Domain></CycloneDDS>"}
        )


def test_without_the_package_one_line_says_how_to_get_it():
    script = (
        "import sys; sys.modules['cyclonedds'] = None\n"
        "from edge.sinks.registry import open_sink\n"
        "try: open_sink('ros2:skin', None)\n"
        "except ValueError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout == f"ros2:skin needs Cyclone DDS: pip install '{ROOT}[ros2]'\n", done.stderr
