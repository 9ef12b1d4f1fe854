"""From what a user writes to a link."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

from firmware_bridge.errors import SourceError
from firmware_bridge.links.base import Link
from firmware_bridge.links.ports import find_adapter, find_by_serial, serial_ports
from firmware_bridge.xela import USPA44_MAP, ModelMap, trigger_frames

if TYPE_CHECKING:
    from firmware_bridge.links.slcan_serial import SlcanSerialLink

FORMS: Final = (
    "slcan:/dev/ttyUSB0[@baud]",
    "slcan:serial=D30BL366[@baud]",
    "replay:FILE[,FILE]",
    "demo",
)


# Each link is loaded only where it is asked for: start-up time and memory are for what runs.


def open_source(
    text: str | None,
    rate_hz: float | None = None,
    demo_recording: str | Path | None = None,
    model: ModelMap = USPA44_MAP,
) -> Link:
    """The link that `text` names, not yet entered; for None the one known adapter there is.

    Args:
        text: one of FORMS.
        rate_hz: scans a second at which recordings are played; a device has its own.
        demo_recording: what "demo" plays.
        model: which CAN id is which taxel, for a device.

    Raises:
        SourceError: no such form.
        NoDeviceError: no adapter, or several, and none was named.
        RecordingError: a recording that cannot be used.
    """
    if text is None:
        return _slcan_link(find_adapter(serial_ports()).path, None, model)
    scheme, _, rest = text.partition(":")
    if scheme == "slcan":
        return _slcan(text, rest, model)
    if scheme == "replay" and rest:
        from firmware_bridge.links.replay import ReplayLink

        # A file may have a comma in its name.
        return ReplayLink([rest] if Path(rest).exists() else rest.split(","), rate_hz)
    if text == "demo" and demo_recording is not None:
        from firmware_bridge.links.demo import DemoLink

        return DemoLink(demo_recording, rate_hz)
    raise _refusal(text)


def _slcan(text: str, rest: str, model: ModelMap) -> Link:
    port, at, baud = rest.rpartition("@")
    if not at:
        port = rest
    if port in ("", "serial=") or (at and not (baud.isascii() and baud.isdigit() and int(baud) > 0)):
        raise _refusal(text)
    if port.startswith("serial="):
        port = find_by_serial(port.removeprefix("serial="), serial_ports()).path
    link = _slcan_link(port, int(baud) if at else None, model)
    link.name = text
    return link


def _slcan_link(port: str, baud: int | None, model: ModelMap) -> "SlcanSerialLink":
    from firmware_bridge.links.slcan_serial import DEFAULT_BAUD, SlcanSerialLink

    return SlcanSerialLink(port, DEFAULT_BAUD if baud is None else baud, model=model, triggers=trigger_frames(model))


def _refusal(text: str) -> SourceError:
    return SourceError(f"source is {text!r}, expected one of: {', '.join(FORMS)}")
