"""Devices on which every link can be tried alike: they give scans when asked, are pulled out and put back."""

import errno
import threading
import time
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path

import can
from bridge_samples import decoded, frames_of, make_counts, read_scans, write_recording
from can.interfaces.virtual import VirtualBus
from gs_usb_emulator import GsUsbBackend, GsUsbPort
from xela_server_emulator import looping

from firmware_bridge.can.slcan import CanFrame, SlcanDecoder, encode_frame
from firmware_bridge.emulation.pty_port import PseudoPort, listen
from firmware_bridge.links.base import Link
from firmware_bridge.links.can_bus import CanBusLink
from firmware_bridge.links.demo import DemoLink
from firmware_bridge.links.gs_usb_link import GsUsbLink
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.links.xela_server import XelaServerLink
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.frame_scans import GsUsbScans
from firmware_bridge.scans.mounting import placed_map
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.scan_assembler import ScanAssembler
from firmware_bridge.scans.slcan_scans import SlcanScans
from firmware_bridge.scans.xela_server_scans import ServerScans

FRAME_US = 300  # a bus slow enough for a busy machine: stamps six times slower than frames arrive are no clock


class Rig:
    """A device and links to it."""

    name: str  # what a link to it says, as are `kind`, and `sensor` in its scans
    kind = "emulated"
    sensor = "4"
    lost = away = ""  # words of the error once it was pulled out, and of opening a link to it then
    decoder: type  # whose counters the link passes on
    make: Callable[..., Link]  # a new one, of these settings

    def link(self, prefix: str = "", **settings) -> Link:
        """Return a link, the names of whose sensors begin so."""
        if prefix:
            settings |= (
                {"model": placed_map(USPA44_MAP, {}, prefix)} if isinstance(self, CanRig) else {"prefix": prefix}
            )
        link = self.make(**settings)
        link.prefix = prefix
        return link

    def give(self, link: Link, scans: int) -> list[Scan]:
        """Return the next scans, at least so many."""
        return read_scans(link, scans)

    def lose(self) -> None:
        """Pull it out."""

    def put_back(self) -> None:
        """Put it back."""

    def close(self) -> None:
        """Release what it holds."""


class CanRig(Rig):
    """An adapter that hears exactly the frames that a test sends, at the times of a bus without pauses."""

    hear_at: Callable[[CanFrame, int], None]
    sent: Callable[[int], list[CanFrame]]  # so many frames that a link has sent

    def __init__(self) -> None:
        self._seeds = count()
        self._bus_us = 0

    def hear(self, *frames: CanFrame) -> None:
        """Receive frames, one after the other however long this machine takes."""
        for frame in frames:
            self._bus_us += FRAME_US
            self.hear_at(frame, self._bus_us)

    def give(self, link: Link, scans: int) -> list[Scan]:
        given = []
        for _ in range(scans):
            self._bus_us = max(self._bus_us + 1000, time.monotonic_ns() // 1000)  # a pause, and the clock is one
            given += self.read(link, frames_of(1, seed=next(self._seeds)))
        return given

    def read(self, link: Link, frames: Sequence[CanFrame]) -> list[Scan]:
        """Return the scans of these frames, few of which wait at a time."""
        scans = []
        for some in (frames[at : at + 32] for at in range(0, len(frames), 32)):
            until = link.counters()["frames"] + len(some)
            self.hear(*some)
            while link.counters()["frames"] < until:
                scans += link.read(0.005)
        return scans


class SlcanRig(CanRig):
    """A pseudo-terminal behind a link that the user named, as udev makes it."""

    lost, away = "link lost, the cable or the adapter is gone", "no such port"
    decoder = SlcanScans

    def __init__(self, folder: Path, monkeypatch) -> None:
        super().__init__()
        self._port = PseudoPort(folder / "skin")
        self._port.plug()
        self.name = f"slcan:{self._port.path}"
        self.lose = self.close = self._port.unplug

    def make(self, **settings):
        return SlcanSerialLink(self._port.path, **settings)

    def hear_at(self, frame, bus_us):
        line = encode_frame(frame._replace(timestamp_ms=bus_us // 1000 % 60_000))
        assert self._port.write(line) == len(line)

    def sent(self, frames):
        decoder, heard = SlcanDecoder(), []
        while len(heard) < frames:
            heard += decoded(decoder, b"".join(listen([self._port], 0.1).values()))
        return heard

    def put_back(self):
        self._port.plug(elsewhere=True)


class GsUsbRig(CanRig):
    """A candleLight on pretended USB."""

    name, kind = "gs_usb", "device"
    lost, away = "link lost, the cable or the adapter is gone", "no gs_usb adapter"
    decoder = GsUsbScans

    def __init__(self, folder, monkeypatch) -> None:
        super().__init__()
        self._port = GsUsbPort()
        self._backend = GsUsbBackend(self._port)
        self.put_back = self._port.plug

    def make(self, **settings):
        return GsUsbLink(backend=self._backend, **settings)

    def hear_at(self, frame, bus_us):
        self._port.adapter.hear(frame, stamp_us=bus_us)

    def sent(self, frames):
        return self._port.adapter.sent

    def lose(self):
        self._port.adapter.unplug()


class PulledBus(VirtualBus):
    """The virtual bus with a cable: its drivers tell at once that it is out."""

    def __init__(self, plugged: threading.Event, **settings) -> None:
        if not plugged.is_set():
            raise can.CanInitializationError("no such channel")
        self._plugged = plugged
        super().__init__(**settings)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        assert timeout is not None, "a link that waits for ever"
        end_s = time.monotonic() + timeout
        while True:
            if not self._plugged.is_set():
                raise can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN)
            message = super().recv(max(0.0, min(end_s - time.monotonic(), 0.01)))
            if message is not None or time.monotonic() >= end_s:
                return message


class PythonCanRig(CanRig):
    """The virtual bus of python-can, with somebody else on it."""

    lost, away = "link lost, the interface is gone or down: .*Network is down", "cannot be opened: no such channel"
    decoder = ScanAssembler

    def __init__(self, folder: Path, monkeypatch) -> None:
        super().__init__()
        self._channel = folder.name
        self.name = f"can:virtual:{self._channel}"
        self._far = VirtualBus(channel=self._channel, preserve_timestamps=True)
        self._plugged = threading.Event()
        self._plugged.set()
        self.lose, self.put_back, self.close = self._plugged.clear, self._plugged.set, self._far.shutdown
        monkeypatch.setattr(can, "Bus", lambda *, channel, **_: PulledBus(self._plugged, channel=channel))

    def make(self, **settings):
        return CanBusLink("virtual", self._channel, **settings)

    def hear_at(self, frame, bus_us):
        self._far.send(message_of(frame, timestamp=bus_us / 1e6))

    def sent(self, frames):
        heard = [self._far.recv(1.0) for _ in range(frames)]
        return [CanFrame(one.arbitration_id, bytes(one.data), one.is_extended_id) for one in heard if one]


def message_of(frame: CanFrame, **settings) -> can.Message:
    """Return a frame as python-can has it."""
    settings = {"is_extended_id": frame.extended, "is_remote_frame": frame.remote} | settings
    return can.Message(arbitration_id=frame.can_id, data=frame.data, **settings)


def make_network(root: Path, name: str, *, up: bool, kind: str = "280", driver: str | None = None) -> None:
    """Make a CAN network, or another one, of a pretended /sys."""
    network = root / "class/net" / name
    network.mkdir(parents=True)
    (network / "flags").write_text("0x40081\n" if up else "0x40080\n")
    (network / "type").write_text(f"{kind}\n")
    if driver:
        (root / driver).mkdir()
        (network / "device").mkdir()
        (network / "device/driver").symlink_to(root / driver)


class ServerRig(Rig):
    """The vendor's server, emulated."""

    kind, sensor = "device", "1"
    lost, away = "link lost, the server is gone", "connection refused"
    decoder = ServerScans

    def __init__(self, folder, monkeypatch) -> None:
        self._server = looping()
        self._server.__enter__()
        self.name = f"xela-server:{self._server.url}"
        self.lose, self.put_back = self._server.kill, self._server.start_again

    def make(self, **settings):
        return XelaServerLink(self._server.url, **settings)

    def close(self):
        self._server.__exit__()


class DemoRig(Rig):
    """The demo, whose emulator hangs up."""

    name = "demo"
    lost = "link lost, the cable or the adapter is gone"

    def __init__(self, folder: Path, monkeypatch) -> None:
        self._recording = write_recording(folder / "demo.csv", make_counts(30), rate_hz=100)

    def make(self, **settings):
        self._link = DemoLink(self._recording, loop=True)
        return self._link

    def lose(self):
        assert self._link.emulator is not None
        self._link.emulator.hang_up()


class ReplayRig(Rig):
    """A recording, which nobody can pull out."""

    kind, sensor = "replay", "finger"

    def __init__(self, folder: Path, monkeypatch) -> None:
        self._recording = write_recording(folder / "finger.csv", make_counts(200), rate_hz=100)
        self.name = f"replay:{self._recording}"

    def make(self, **settings):
        return ReplayLink([self._recording])
