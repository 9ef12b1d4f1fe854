"""From what a user writes to a link."""

from pathlib import Path
from typing import Final

from firmware_bridge.errors import SourceError
from firmware_bridge.links.base import Link
from firmware_bridge.links.demo import DemoLink
from firmware_bridge.links.ports import find_adapter, find_by_serial, serial_ports
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.links.slcan_serial import DEFAULT_BAUD, SlcanSerialLink
from firmware_bridge.xela import USPA44_MAP, ModelMap, trigger_frames

FORMS: Final = (
    "slcan:/dev/ttyUSB0[@baud]",
    "slcan:serial=D30BL366[@baud]",
    "replay:FILE[,FILE]",
    "demo",
)


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
        return _slcan_link(find_adapter(serial_ports()).path, DEFAULT_BAUD, model)
    scheme, _, rest = text.partition(":")
    if scheme == "slcan":
        return _slcan(text, rest, model)
    if scheme == "replay" and rest:
        # A file may have a comma in its name.
        return ReplayLink([rest] if Path(rest).exists() else rest.split(","), rate_hz)
    if text == "demo" and demo_recording is not None:
        return DemoLink(demo_recording, rate_hz)
    raise _refusal(text)


def _slcan(text: str, rest: str, model: ModelMap) -> Link:
    port, at, baud = rest.rpartition("@")
    if not at:
        port, baud = rest, str(DEFAULT_BAUD)
    if port in ("", "serial=") or not baud.isascii() or not baud.isdigit() or int(baud) == 0:
        raise _refusal(text)
    if port.startswith("serial="):
        port = find_by_serial(port.removeprefix("serial="), serial_ports()).path
    link = _slcan_link(port, int(baud), model)
    link.name = text
    return link


def _slcan_link(port: str, baud: int, model: ModelMap) -> SlcanSerialLink:
    return SlcanSerialLink(port, baud, model=model, triggers=trigger_frames(model))


def _refusal(text: str) -> SourceError:
    return SourceError(f"source is {text!r}, expected one of: {', '.join(FORMS)}")
