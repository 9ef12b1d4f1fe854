"""Recognition of a USB device that was plugged in again: by its identity, or by its place if others share that."""

from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar


class UsbDevice(Protocol):
    """Device as seen by a link that looks for it."""

    @property
    def identity(self) -> tuple[object, ...] | None:
        """Its identity wherever it is plugged in; None without a serial number."""
        ...

    @property
    def place(self) -> str | None:
        """Its socket, or what comes next to it."""
        ...


_Device = TypeVar("_Device", bound=UsbDevice)


class Recognised(Generic[_Device]):
    """Device that a link has opened. An identity that was once seen twice identifies nothing any more.

    Attributes:
        device: as it was seen last; None before, and without an identity.
    """

    def __init__(self) -> None:
        self.device: _Device | None = None
        self._shared = False

    def learn(self, device: _Device, present: Sequence[_Device]) -> None:
        """Remember a device among all that are present."""
        self.device = None if device.identity is None else device
        self._shared |= [one.identity for one in present].count(device.identity) > 1

    def find(self, present: Sequence[_Device]) -> _Device | None:
        """Return the remembered device among those that are present; None if it is missing, or cannot be told."""
        known = self.device
        same = [one for one in present if known is not None and one.identity == known.identity]
        self._shared |= len(same) > 1
        if self._shared and known is not None:
            same = [one for one in same if one.place == known.place]
        self.device = same[0] if len(same) == 1 else known
        return same[0] if len(same) == 1 else None
