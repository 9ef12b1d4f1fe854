"""Parser of the sources that a user names, into links."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from firmware_bridge.errors import SourceError, as_typed
from firmware_bridge.links.base import Link
from firmware_bridge.links.serial_ports import find_adapter, find_by_serial, serial_ports
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.mounting import Mounting, placed_map

if TYPE_CHECKING:
    from firmware_bridge.recording.tracks import Recording

FORMS: Final = {
    "slcan:/dev/ttyUSB0[@baud]": "serial CAN adapter, such as VScom or CANable",
    "slcan:serial=D30BL366[@baud]": "the same, by its serial number",
    "xela-server:ws://HOST[:5000]": "the vendor's server",
    "gs_usb[:SERIAL]": "USB CAN adapter with candleLight firmware",
    "gs_usb:BUS-PORT": "the one at this bus and socket, such as gs_usb:1-2.3",
    "can:INTERFACE:CHANNEL": "adapter that python-can knows, such as can:socketcan:can0",
    "replay:FILE[,FILE]": "recording: .mcap, .npz or .csv",
    "demo[:loop]": "emulated sensor",
}
"""Forms of a source, and what each is, for the help."""


DEMO_LOOP: Final = "demo:loop"

# Each link is imported only where it is used, to save start-up time and memory.


def open_sources(
    texts: Sequence[str],
    rate_hz: float | None = None,
    demo_recording: str | Path | None = None,
    model: ModelMap = USPA44_MAP,
    *,
    mountings: Mapping[str, Mounting] = MappingProxyType({}),
) -> list[Link]:
    """Create the links that `texts` name, not yet entered; without any, that of the only known adapter.

    Each text is one of FORMS, or NAME=FORM: sensor "4" of NAME is then "NAME/4", also in `mountings`. Among several
    sources, those without a name are called by their place, source1 and so on. `rate_hz` is that of recordings.
    Raises SourceError, NoDeviceError (or several without a choice), and RecordingError.
    """
    links: dict[str, Link] = {}
    for number, text in enumerate(texts or [None], 1):
        match = None if text is None else re.fullmatch(r"([A-Za-z0-9_-]+)=(.+)", text, re.DOTALL)
        name, form = (match[1], match[2]) if match else (f"source{number}" if len(texts) > 1 else "", text)
        prefix = f"{name}/" if name else ""
        link = _link(form, rate_hz, demo_recording, model, mountings, prefix)
        link.prefix = prefix
        if name in links:
            raise SourceError(f"two sources are named {name!r}: give each a name of its own, --source NAME=SRC")
        links[name] = link
    return list(links.values())


def _link(
    text: str | None,
    rate_hz: float | None,
    demo_recording: str | Path | None,
    model: ModelMap,
    mountings: Mapping[str, Mounting],
    prefix: str,
) -> Link:
    """Create the link that `text` names; names of its sensors begin with `prefix`."""
    scheme, _, rest = (text or "").partition(":")
    interface, _, channel = rest.partition(":")
    placed = placed_map(model, mountings, prefix)
    if text is None or scheme == "slcan":
        from firmware_bridge.links.slcan_serial import DEFAULT_BAUD, SlcanSerialLink

        port, baud = (find_adapter(serial_ports()).path, None) if text is None else _port_and_baud(text, rest)
        link = SlcanSerialLink(port, baud or DEFAULT_BAUD, model=placed)
        link.name = text or link.name
        return link
    if scheme == "xela-server" and rest:
        from firmware_bridge.links.xela_server import XelaServerLink

        return XelaServerLink(rest, geometry=placed.geometry, prefix=prefix, mountings=mountings)
    if text == "gs_usb" or (scheme == "gs_usb" and rest):
        from firmware_bridge.links.gs_usb_link import GsUsbLink

        return GsUsbLink(rest or None, model=placed)
    if scheme == "can" and channel:
        from firmware_bridge.links.can_bus import CanBusLink

        return CanBusLink(interface, channel, model=placed)
    if scheme == "replay" and rest:
        from firmware_bridge.links.replay import ReplayLink
        from firmware_bridge.recording.formats import load_recording

        replay = ReplayLink([_named(load_recording(path), prefix) for path in recording_paths(rest)], rate_hz)
        replay.place(mountings)
        return replay
    if text in ("demo", DEMO_LOOP) and demo_recording is not None:
        from firmware_bridge.links.demo import DemoLink

        return DemoLink(demo_recording, rate_hz, loop=text == DEMO_LOOP, model=placed_map(USPA44_MAP, {}, prefix))
    raise _refusal(text)


def recording_paths(text: str) -> list[str]:
    """Split FILE[,FILE] into paths; the name of a single existing file may have a comma in it."""
    return [text] if Path(text).exists() else text.split(",")


def _named(recording: "Recording", prefix: str) -> "Recording":
    """Return a recording whose sensors' names begin with `prefix`."""
    return replace(
        recording,
        tracks=tuple(replace(track, sensor=prefix + track.sensor) for track in recording.tracks),
        mountings={prefix + sensor: mounting for sensor, mounting in recording.mountings.items()},
        poses=[pose if pose.sensor is None else replace(pose, sensor=prefix + pose.sensor) for pose in recording.poses],
    )


def _port_and_baud(text: str, rest: str) -> tuple[str, int | None]:
    """Return the port that a text names after its scheme, and the speed, None if it states none."""
    port, at, baud = rest.rpartition("@")
    if not at:
        port = rest
    if port in ("", "serial="):
        raise _refusal(text)
    if at and not re.fullmatch(r"[1-9][0-9]{0,7}", baud):
        right = as_typed(f"slcan:{port}@115200")
        raise SourceError(f"baud is {baud[:20]!r}, expected 1 to 99999999 after the @: --source {right}")
    if port.startswith("serial="):
        port = find_by_serial(port.removeprefix("serial="), serial_ports()).path
    return port, int(baud) if at else None


def _refusal(text: str) -> SourceError:
    form = _meant(text)
    if form is not None:
        return SourceError(f"source is {text!r}: did you mean {as_typed(form)}?")
    return SourceError(f"source is {text!r}, expected one of: {', '.join(FORMS)}")


def _meant(text: str) -> str | None:
    """Return the likely form of a source named without one, None if there is no guess."""
    if re.fullmatch(r"v?(?:x|sl)?can[0-9]+", text):
        return f"can:socketcan:{text}"
    path = Path(text.partition("@")[0])
    if text.startswith("/dev/") or path.is_char_device():
        return f"slcan:{text}"
    if text.startswith(("ws://", "wss://")):
        return f"xela-server:{text}"
    return f"replay:{text}" if path.suffix.lower() in (".mcap", ".npz", ".csv") or path.is_file() else None
