"""Link over a CAN interface of python-can: socketcan, PEAK, Kvaser and others; esd is on socketcan."""

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from types import ModuleType
from typing import Any, Final, Self

from firmware_bridge.can.gs_usb import BITRATE_BIT_S
from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.errors import DeviceError, LinkLostError, SourceError, how_to_install
from firmware_bridge.links.base import SourceKind, not_open
from firmware_bridge.links.discovery import can_networks
from firmware_bridge.links.frame_link import FrameLink
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.frame_scans import FrameScans
from firmware_bridge.scans.scan import Scan

PRETENDED: Final = ("virtual", "udp_multicast")
_NOT_THROUGH_PYTHON_CAN: Final = {
    "slcan": "use slcan:PORT: python-can's waits 2 s, carries 32 scans a second at its usual speed, and one byte of "
    "noise ends it",
    "gs_usb": "use gs_usb:SERIAL: python-can's never sees that the adapter was unplugged or has lost frames",
}


class CanBusLink(FrameLink):
    """Link to a sensor on an interface of python-can, whose time-outs grow where the wall clock is set back."""

    def __init__(
        self,
        interface: str,
        channel: str,
        *,
        model: ModelMap = USPA44_MAP,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Prepare a link to a channel such as "can0" of an interface such as "socketcan"; opens nothing yet.

        Raises SourceError for an interface that is not supported, and DeviceError where python-can is not installed.
        """
        self._scans = FrameScans(model)
        super().__init__(self._scans, clock_ns)
        self._triggers = model.triggers
        self.name = f"can:{interface}:{channel}"
        no_wire = interface == "socketcan" and channel.startswith(("vcan", "vxcan"))  # every device there is emulated
        self.kind: SourceKind = "emulated" if no_wire or interface in PRETENDED else "device"
        if interface in _NOT_THROUGH_PYTHON_CAN:
            raise SourceError(f"source is {self.name!r}: {_NOT_THROUGH_PYTHON_CAN[interface]}")
        self._can = _python_can()
        usable = set(self._can.VALID_INTERFACES) - set(_NOT_THROUGH_PYTHON_CAN)
        if interface not in usable:
            raise SourceError(f"source is {self.name!r}, expected can:INTERFACE:CHANNEL of {', '.join(sorted(usable))}")
        self._interface = interface
        self._channel = channel
        self._counts = dict.fromkeys(("frames", "error_frames", "fd_frames"), 0)
        self._bus: Any = None

    def __enter__(self) -> Self:
        if self._interface == "socketcan":
            _check_network(self._channel)
            self._scans.errors.reopened()  # a socket restarts no controller, and the kernel reports bus-off once
        else:
            self._scans.errors.restarted()
        with self._counting:
            self._scans.begin_anew()
        self._scans.clock.begin_anew()
        self._unread.empty_ns = self._clock_ns()
        self._bus = self._open()
        try:
            for frame in self._triggers:
                message = self._can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
                self._bus.send(message, timeout=1.0)
        except (self._can.CanError, OSError) as error:
            self._close()
            raise DeviceError(f"{self.name}: does not send frames: {error}") from error
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._bus is not None:
            self._close()

    def counters(self) -> dict[str, int]:
        """Return the counts of frames by kind, bus and assembler."""
        with self._counting:
            return self._counts | self._scans.counters()

    def _fetch(self, timeout_s: float) -> Any:
        if self._bus is None:
            raise not_open()
        try:
            message = self._bus.recv(timeout_s)
            if message is None and self._bus.state is self._can.BusState.ERROR:
                self._scans.errors.left_the_bus()
        except (self._can.CanError, OSError) as error:
            self._scans.errors.restarted()  # a network that comes up, or an adapter that is plugged in, restarts
            raise LinkLostError(f"{self.name}: link lost, the interface is gone or down: {error}") from error
        return message

    def _take(self, piece: Any, time_ns: int) -> list[Scan]:
        if piece.is_error_frame:
            self._counts["error_frames"] += 1
            if self._interface == "socketcan":  # each other driver reports it in its own way
                self._scans.errors.error_frame(piece.arbitration_id, bytes(piece.data), time_ns)
            return []
        if piece.is_fd:
            self._scans.errors.frame_heard()
            self._counts["fd_frames"] += 1
            return []
        self._counts["frames"] += 1
        frame = CanFrame(piece.arbitration_id, bytes(piece.data), piece.is_extended_id, piece.is_remote_frame)
        # By the wall clock or the driver's own clock; zero where there is no stamp.
        return self._scans.feed_frame(frame, round(piece.timestamp * 1e6) or None, time_ns)

    def _open(self) -> Any:
        settings: dict[str, Any] = {}
        channel: str | int = self._channel
        if self._interface == "socketcan":  # the kernel filters; on other interfaces a filter costs more than it saves
            settings["can_filters"] = [{"can_id": 0, "can_mask": 0, "extended": False}]
        elif self._interface not in PRETENDED:  # the others have no bitrate of their own
            settings["bitrate"] = BITRATE_BIT_S
            if self._channel.isascii() and self._channel.isdigit():
                channel = int(self._channel)
        try:
            return self._can.Bus(channel=channel, interface=self._interface, ignore_config=True, **settings)
        except (self._can.CanError, OSError) as error:
            raise DeviceError(f"{self.name}: cannot be opened: {error}") from error
        # Some interfaces let through every error that a missing or incomplete driver causes.
        except (NameError, AttributeError, TypeError, KeyError, ValueError, ImportError, NotImplementedError) as error:
            raise DeviceError(
                f"{self.name}: cannot be opened, is its driver installed and the channel's name right? {error}"
            ) from error

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        with suppress(self._can.CanError, OSError):  # gone already
            bus.shutdown()


def _python_can() -> ModuleType:
    logging.getLogger("can").addHandler(logging.NullHandler())  # its problems arrive as exceptions as well
    try:
        import can
    except ImportError as error:
        raise DeviceError(f"can: sources need python-can: {how_to_install('can')}") from error
    return can


def _check_network(name: str) -> None:
    """Refuse a network that is missing or down, which socketcan opens without an error."""
    networks = {network.name: network for network in can_networks()}
    if name not in networks:
        raise DeviceError(
            f"no CAN network {name}: plug the adapter in, and load its driver. CAN networks seen: "
            f"{', '.join(networks) or 'none'}"
        )
    if problem := networks[name].problem:
        raise DeviceError(f"CAN network {name} {problem}")
