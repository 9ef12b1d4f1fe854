"""Poses over zenoh: the same JSON as on stdin, one pose a message, in a session that does nothing else."""

import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from edge.errors import SinkError
from edge.pipeline.pose_queue import PoseQueue
from edge.sinks.zenoh import configured, reason_of, understood
from firmware_bridge.extras import how_to_install

if TYPE_CHECKING:
    import zenoh

CLOSE_S: Final = 0.5


class ZenohPoses:
    """Subscriber to the key of poses; poses of zenoh's thread go to the queue as they come."""

    def __init__(self, target: str, queue: PoseQueue, sensor: str | None = None) -> None:
        """Open a session; it does not matter whether a publisher is there, now or later.

        Args:
            target: as of the sink: KEY, KEY?connect=ENDPOINT[,ENDPOINT] or KEY?config=FILE.json5.
            queue: of the poses.
            sensor: sensor of the poses that name none.

        Raises:
            UsageError: the target has another form.
            SinkError: zenoh is not installed, or the session cannot be opened.
        """
        key, configuration = understood(target)
        try:
            import zenoh
        except ImportError as error:
            raise SinkError(f"zenoh: needs eclipse-zenoh: {how_to_install('zenoh')}") from error
        self._zenoh = zenoh
        self._queue = queue
        self._sensor = sensor
        try:
            self._session = zenoh.open(configured(configuration))
            # In zenoh's thread, since a thread in between would add its own delay to a time of arrival.
            self._subscriber = self._session.declare_subscriber(
                key, zenoh.handlers.Callback(self._take, indirect=False)
            )
        except zenoh.ZError as error:
            raise SinkError(f"zenoh cannot be opened: {reason_of(error)}") from error

    def close(self) -> None:
        """End the session; a router that stands still is waited for CLOSE_S at most."""
        closing = threading.Thread(target=self._close, name="zenoh-close", daemon=True)
        closing.start()
        closing.join(CLOSE_S)

    def _close(self) -> None:
        with suppress(self._zenoh.ZError):  # it took too long
            self._session.close()

    def _take(self, sample: "zenoh.Sample") -> None:
        self._queue.put_json(sample.payload.to_bytes(), time.monotonic_ns(), self._sensor)
