"""Sources of poses beside stdin, by the names that a user writes, and that over zenoh."""

import re
import time
from typing import TYPE_CHECKING, Final, Protocol

from edge.errors import UsageError
from edge.pipeline.pose_queue import PoseQueue
from edge.sinks.registry import needs_cyclone_dds
from edge.sinks.ros2.cdr_messages import base_topic
from edge.sinks.zenoh import close_session, open_session, opening, parsed_target

if TYPE_CHECKING:
    import zenoh

FORMS: Final = ("zenoh[:KEY]", "ros2:TOPIC")


class PoseSource(Protocol):
    """Open source of poses, which receives in a thread of its own until it is closed."""

    def close(self) -> None:
        """End it."""


def check_poses(text: str) -> tuple[str | None, str, str]:
    """Return sensor, form and target of the source that `text` names, FORM or SENSOR=FORM, or raise a UsageError."""
    match = re.fullmatch(r"([A-Za-z0-9_/-]{1,64})=(.+)", text, re.DOTALL)
    sensor, form_text = (match[1], match[2]) if match else (None, text)
    form, _, target = form_text.partition(":")
    if form == "zenoh":
        target = target or "pose"
        parsed_target(target)
    elif form == "ros2" and target:
        target = base_topic(target)
    else:
        raise UsageError(f"no source of poses {text!r}; they are {', '.join(FORMS)}, or SENSOR= before one of them")
    return sensor, form, target


def open_poses(text: str, queue: PoseQueue) -> PoseSource:
    """Open the source of poses that `text` names, as for `check_poses`; they go to the queue.

    Raises a UsageError where a package is not installed, and a SinkError where it cannot be opened.
    """
    sensor, form, target = check_poses(text)
    if form == "zenoh":
        return ZenohPoses(target, queue, sensor)
    with needs_cyclone_dds(text):
        from edge.pose_sources.ros2_poses import Ros2Poses
    return Ros2Poses(target, queue, sensor)


class ZenohPoses:
    """Subscriber to a key of poses, the same JSON as on stdin, one a message; `sensor` is that of those with none."""

    def __init__(self, target: str, queue: PoseQueue, sensor: str | None) -> None:
        """Open a session; it does not matter whether a publisher is there, now or later."""
        key, self._session = open_session(target)
        import zenoh

        def take(sample: "zenoh.Sample") -> None:
            queue.put_json(sample.payload.to_bytes(), time.monotonic_ns(), sensor)

        with opening():
            # In zenoh's thread, since a thread in between would add its own delay to a time of arrival.
            called = zenoh.handlers.Callback(take, indirect=False)
            self._subscriber = self._session.declare_subscriber(key, called)

    def close(self) -> None:
        """End the session."""
        close_session(self._session)
