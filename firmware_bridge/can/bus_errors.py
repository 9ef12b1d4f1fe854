"""What goes wrong on a CAN bus and in its controller: counted by sort, and how it stands now. No I/O, no clock.

An error frame is no frame from the bus: the controller makes it to tell of something.
Source: Linux include/uapi/linux/can/error.h, whose bits socketcan and gs_usb adapters share.
"""

from typing import Final

BUS_OFF: Final = 0x40
RESTARTED: Final = 0x100
CONTROLLER: Final = 0x04
"""What data byte 1 tells of."""
RX_OVERFLOW: Final = 0x01
TX_OVERFLOW: Final = 0x02
WARNING: Final = 0x04 | 0x08
PASSIVE: Final = 0x10 | 0x20

LOST_RECENTLY_NS: Final = 5_000_000_000
"""So long is a loss of frames worth telling."""

_COUNTED: Final[tuple[str, ...]] = (
    "bus_off",
    "error_passive",
    "error_warnings",
    "other_errors",
    "controller_overflows",
    "overflows",
)
_TROUBLE: Final = {
    "bus_off": "bus-off, the adapter has left the bus: check wires, termination and who else sends at another bitrate",
    "error_passive": "error-passive, most of what is on the bus is garbled: check wires, termination and bitrate",
}


class BusErrors:
    """Counts error frames by sort, and knows the state of the controller."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)
        self._state: str | None = None
        self._told_before_opening = False
        self._lost_ns: int | None = None

    def error_frame(self, classes: int, data: bytes, time_ns: int) -> None:
        """Take an error frame.

        Args:
            classes: of errors, the bits of its id.
            data: what it tells more.
            time_ns: monotonic time of its arrival, in [ns].
        """
        self._told_before_opening = False
        controller = data[1] if classes & CONTROLLER and len(data) > 1 else 0
        if controller & RX_OVERFLOW:
            self._counts["controller_overflows"] += 1
            self._lost_ns = time_ns
        if classes & BUS_OFF:
            self.left_the_bus()
        elif controller & PASSIVE:
            self._enter("error_passive")
        elif controller & WARNING:
            self._counts["error_warnings"] += 1
            self._state = None
        elif classes & RESTARTED or (classes & CONTROLLER and not controller & (RX_OVERFLOW | TX_OVERFLOW)):
            self._state = None
        elif not controller & RX_OVERFLOW:
            self._counts["other_errors"] += 1

    def unsorted_error(self) -> None:
        """Take an error frame of which nobody knows what it says."""
        self._counts["other_errors"] += 1

    def overflow(self, time_ns: int) -> None:
        """Take an adapter's word that it had no room for frames, at `time_ns` [ns] of monotonic time."""
        self._counts["overflows"] += 1
        self._lost_ns = time_ns

    def left_the_bus(self) -> None:
        """Take it that the controller is bus-off; counted once until it is back."""
        self._enter("bus_off")

    def reopened(self) -> None:
        """Take it that the controller went on while nobody listened: its state holds until a frame says otherwise."""
        self._told_before_opening = True

    def restarted(self) -> None:
        """Take it that the controller began anew."""
        self._state = None

    def frame_heard(self) -> None:
        """Take it that a frame came: who has left the bus hears none."""
        if self._state == "bus_off" or self._told_before_opening:
            self._state = None
        self._told_before_opening = False

    def trouble(self, time_ns: int) -> str | None:
        """What the user must know of at `time_ns` [ns] of monotonic time; None while all is well."""
        troubles = [] if self._state is None else [_TROUBLE[self._state]]
        if self._lost_ns is not None and time_ns - self._lost_ns < LOST_RECENTLY_NS:
            troubles.append("the adapter has lost frames: they are not fetched fast enough")
        return "; ".join(troubles) or None

    def counters(self) -> dict[str, int]:
        """By sort.

        bus_off, error_passive: times that the controller got there; error_warnings; other_errors: frames that were
        garbled, as far as it tells; controller_overflows: times that it had no room for a frame; overflows: the same
        of the adapter's queue.
        """
        return dict(self._counts)

    def _enter(self, state: str) -> None:
        self._counts[state] += self._state != state
        self._state = state
