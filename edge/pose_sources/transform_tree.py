"""Tree of the transforms on /tf and /tf_static, as far as the pose of one frame in another needs it. No I/O."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from edge.pose_sources.tool_frame import Placed, placed

MOST_FRAMES: Final = 4096
DEEPEST: Final = 64
"""Most frames from one to the root, more than any robot has: a ring of frames ends there."""


class Found(NamedTuple):
    """Pose of one frame in another.

    Attributes:
        tool: of the pose.
        stamp_ns: oldest time of the transforms that move, in [ns] since 1970; None if none of them moves.
    """

    tool: Placed
    stamp_ns: int | None


class _Link(NamedTuple):
    parent: str
    placed: Placed
    stamp_ns: int | None


class TransformTree:
    """Newest transform of every frame."""

    def __init__(self, parent: str, child: str) -> None:
        """Begin without a transform.

        Args:
            parent: frame in which the pose is wanted.
            child: frame whose pose is wanted.
        """
        self._parent, self._child = parent, child
        self._links: dict[str, _Link] = {}
        self._last_ns = -1

    def add(self, message: Mapping[str, Any], *, moves: bool) -> Found | None:
        """Take a TFMessage; return the pose if it is newer than the last one that was returned.

        Args:
            message: decoded.
            moves: False for /tf_static.

        Raises:
            PoseError: a transform is no rotation and place.
        """
        for one in message["transforms"]:
            frame, stamp = one["child_frame_id"], one["header"]["stamp"]
            if frame not in self._links and len(self._links) >= MOST_FRAMES:
                continue
            transform = one["transform"]
            self._links[frame] = _Link(
                one["header"]["frame_id"],
                placed(transform["translation"], transform["rotation"]),
                stamp["sec"] * 1_000_000_000 + stamp["nanosec"] if moves else None,
            )
        return self._newest()

    def _newest(self) -> Found | None:
        root, tool, stamps_ns = self._climb(self._child, self._parent)
        if root != self._parent:
            other_root, plane, more_ns = self._climb(self._parent, root)
            if other_root != root:
                return None
            back = plane.rotation.T
            tool = Placed(back @ (tool.place_m - plane.place_m), back @ tool.rotation)
            stamps_ns += more_ns
        stamp_ns = min(stamps_ns, default=None)
        # One that does not move has time 0, and is returned once.
        if (stamp_ns or 0) <= self._last_ns:
            return None
        self._last_ns = stamp_ns or 0
        return Found(tool, stamp_ns)

    def _climb(self, frame: str, end: str) -> tuple[str, Placed, list[int]]:
        """Return the last frame on the way from a frame to the root, `end` if it lies there, and the pose in it."""
        place_m, rotation, stamps_ns = np.zeros(3), np.eye(3), []
        for _ in range(DEEPEST):
            link = self._links.get(frame)
            if frame == end or link is None:
                break
            place_m = link.placed.rotation @ place_m + link.placed.place_m
            rotation = link.placed.rotation @ rotation
            frame = link.parent
            if link.stamp_ns is not None:
                stamps_ns.append(link.stamp_ns)
        return frame, Placed(place_m, rotation), stamps_ns
