"""Valid ROS 2 names for topics that users and sensors name."""

import re
from typing import Final

from edge.errors import SinkError, UsageError

LONGEST_TOPIC: Final = 247
"""Limit of ROS; DDS takes 255, some of which are for prefixes."""
_ALLOWED: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_PLAIN: Final = re.compile(r"(?!s[0-9])(?!x_)[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*")
_FROM_DIGIT: Final = re.compile(r"[0-9][A-Za-z0-9]*(_[A-Za-z0-9]+)*")


def base_topic(text: str) -> str:
    """Return a topic as a user writes it, without a leading slash.

    Raises:
        UsageError: it is no valid topic of ROS.
    """
    topic = text.removeprefix("/")
    if not all(_ALLOWED.fullmatch(token) for token in topic.split("/")):
        raise UsageError(
            f"topic {text!r} is not a ROS topic: expected letters, digits and _ between single slashes, no digit "
            "first, such as ros2:skin or ros2:/gripper/skin"
        )
    return topic


def sensor_path(sensor: str) -> str:
    """Return the part of a topic that stands for a sensor; no two sensors share one.

    "4" becomes s4, "left/4" left/s4; a name that is not valid in ROS, or could be taken for another, becomes x_ and its
    UTF-8 in hexadecimal digits.
    """
    return "/".join(map(_token, sensor.split("/")))


def sensor_topic(base: str, sensor: str, what: str) -> str:
    """Return the topic of one thing that is published of a sensor; a SinkError where it is too long for ROS."""
    topic = "/".join((base, sensor_path(sensor), what))
    if len(topic) >= LONGEST_TOPIC:
        raise SinkError(
            f"topic {topic} has {len(topic)} characters, ROS holds {LONGEST_TOPIC - 1}: name sensor {sensor!r} shorter"
        )
    return topic


def _token(part: str) -> str:
    if _PLAIN.fullmatch(part):
        return part
    if _FROM_DIGIT.fullmatch(part):
        return f"s{part}"
    return f"x_{part.encode().hex() or '0'}"
