"""Registry of the sources of poses, by the names that a user writes."""

import re
from typing import Final, NamedTuple, Protocol

from edge.errors import UsageError
from edge.pipeline.pose_queue import PoseQueue
from edge.sinks.ros2.topic_names import base_topic
from firmware_bridge.extras import how_to_install

FORMS: Final = ("zenoh[:KEY]", "ros2:TOPIC")
DEFAULT_KEY: Final = "pose"
_NAMED: Final = re.compile(r"([A-Za-z0-9_/-]{1,64})=(.+)", re.DOTALL)


class PoseSource(Protocol):
    """Open source of poses, which receives in a thread of its own."""

    def close(self) -> None:
        """End it."""
        ...


class Wanted(NamedTuple):
    """Source of poses as a user names it: the sensor of the poses, None for all; the form, and what follows it."""

    sensor: str | None
    form: str
    target: str


def check_poses(text: str) -> Wanted:
    """Return the source of poses that `text` names; nothing is opened.

    Args:
        text: one of FORMS, or SENSOR=FORM for the poses of one sensor.

    Raises:
        UsageError: no such form.
    """
    match = _NAMED.fullmatch(text)
    sensor, form_text = (match[1], match[2]) if match else (None, text)
    form, _, target = form_text.partition(":")
    if form == "zenoh":
        from edge.sinks.zenoh import understood

        target = target or DEFAULT_KEY
        understood(target)
    elif form == "ros2" and target:
        target = base_topic(target)
    else:
        raise UsageError(f"no source of poses {text!r}; they are {', '.join(FORMS)}, or SENSOR= before one of them")
    return Wanted(sensor, form, target)


def open_poses(text: str, queue: PoseQueue) -> PoseSource:
    """Open the source of poses that `text` names.

    Args:
        text: as for `check_poses`.
        queue: of the poses that it receives.

    Raises:
        UsageError: no such form, or what it needs is not installed.
        SinkError: it cannot be opened.
    """
    sensor, form, target = check_poses(text)
    if form == "zenoh":
        from edge.pose_sources.zenoh_poses import ZenohPoses

        return ZenohPoses(target, queue, sensor)
    try:
        from edge.pose_sources.ros2_poses import Ros2Poses
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "cyclonedds":
            raise
        raise UsageError(f"{text} needs Cyclone DDS: {how_to_install('ros2')}") from error
    return Ros2Poses(target, queue, sensor)
