"""State of a CAN controller, by the error frames by which it, and not the bus, reports an event. No I/O, no clock.

Source: Linux include/uapi/linux/can/error.h, whose bits socketcan and gs_usb adapters share.
"""

from typing import Final

BUS_OFF: Final = 0x40
CONTROLLER: Final = 0x04  # error class whose details are in data byte 1
RX_OVERFLOW: Final = 0x01

LOST_RECENTLY_NS: Final = 5_000_000_000  # time for which a loss of frames is reported, in [ns]

_TROUBLE: Final = {
    "bus_off": "bus-off, the adapter has left the bus: check wires, termination and the bitrate of every node",
    "error_passive": "error-passive, most frames on the bus are garbled: check wires, termination and bitrate",
}


class BusErrors:
    """State of the controller, and counters of what it went through."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = dict.fromkeys(("bus_off", "error_passive", "overflows"), 0)
        self._state: str | None = None
        self._told_before_opening = False
        self._lost_ns: int | None = None

    def error_frame(self, classes: int, data: bytes, time_ns: int) -> None:
        """Process an error frame of the error classes in its id, with their details, that came at `time_ns` [ns]."""
        self._told_before_opening = False
        controller = data[1] if classes & CONTROLLER and len(data) > 1 else 0
        if controller & RX_OVERFLOW:
            self.overflow(time_ns)
        if classes & BUS_OFF:
            self.left_the_bus()
        elif controller & 0x30:  # passive, for received frames or sent ones
            self._enter("error_passive")
        elif controller & 0x0C or classes & 0x100 or (classes & CONTROLLER and not controller & 0x03):
            self._state = None  # a mere warning, restarted, or active again

    def overflow(self, time_ns: int) -> None:
        """Count a report that a queue of adapter or controller was full, at `time_ns` [ns] of monotonic time."""
        self._counts["overflows"] += 1
        self._lost_ns = time_ns

    def left_the_bus(self) -> None:
        """Note that the controller is bus-off; counted once until it is back."""
        self._enter("bus_off")

    def reopened(self) -> None:
        """Note that the controller ran on while the link was closed: its state holds until a frame shows another."""
        self._told_before_opening = True

    def restarted(self) -> None:
        """Note that the controller was restarted."""
        self._state = None

    def frame_heard(self) -> None:
        """Note that a frame was received, which a controller in bus-off cannot do."""
        if self._state == "bus_off" or self._told_before_opening:
            self._state = None
        self._told_before_opening = False

    def trouble(self, time_ns: int) -> str | None:
        """Return the trouble to report to the user at `time_ns` [ns] of monotonic time, None if there is none."""
        troubles = [] if self._state is None else [_TROUBLE[self._state]]
        if self._lost_ns is not None and time_ns - self._lost_ns < LOST_RECENTLY_NS:
            troubles.append("the adapter has lost frames: they are not read fast enough")
        return "; ".join(troubles) or None

    def counters(self) -> dict[str, int]:
        """Return how often the controller entered each state, and how often it, or the adapter's queue, had no room."""
        return dict(self._counts)

    def _enter(self, state: str) -> None:
        self._counts[state] += self._state != state
        self._state = state
