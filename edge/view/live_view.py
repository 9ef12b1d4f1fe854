"""Live page of a run: its store, its access, its server, and the recorder that a viewer may start."""

import secrets
import socket
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Final, Self

from edge.inference.contract import Contract
from edge.mapping.live_map import MapState
from edge.perception.event import Event
from edge.pipeline.commands import Commands
from edge.pipeline.sink import Sink
from edge.view.access import grant, is_everything, own_addresses
from edge.view.frames import Run
from edge.view.recorder import FORM, Recorder
from edge.view.run_snapshot import RunSnapshot
from edge.view.server import Server
from firmware_bridge.links.base import SourceKind
from firmware_bridge.links.replay_player import Player

LOOPBACK: Final = "127.0.0.1"


class LiveView:
    """Live page of a run; the port is taken at once, and pages are answered from `begin` on.

    Attributes:
        sinks: sinks that the loop writes to; they never fail.
        url: the page's address.
        other_urls: more addresses of it, where it listens at all addresses of this machine.
    """

    def __init__(
        self, host: str, port: int, token: str | None, record_dir: Path, contract: Contract, commands: Commands
    ) -> None:
        """Take the port, 0 for any free one, where `host` leads.

        Requests must carry the token; None makes one where other machines can reach `host`. Recordings are made in
        `record_dir`. Raises UsageError where the token is not valid, SinkError where the port cannot be taken.
        """
        access = grant(host, socket.gethostname(), token)
        self._snapshot = RunSnapshot()
        self._messages: Callable[[Event], object] = lambda event: None
        self._recorder = Recorder(record_dir, self._tell)
        commands.record = self._recorder.record
        import_module(f"edge.sinks.{FORM}")  # now, not between two scans: the import may take a fifth of a second
        self._server = Server(self._snapshot, commands, access, port, self._recorder, failed=self._failed)
        self._snapshot.wake = self._server.wake
        self._contract = contract
        self.sinks: list[Sink] = [self._recorder, self._snapshot]
        addresses = own_addresses(host) if is_everything(host) else []
        self.url, *self.other_urls = access.urls(self._server.port, addresses)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        try:
            self._recorder.close()
        finally:
            self._server.close()

    def begin(
        self,
        name: str,
        kind: SourceKind,
        model: str,
        open_sink: Callable[[str], Sink],
        messages: Callable[[Event], object],
        player: Player | None = None,
    ) -> None:
        """Answer requests from now on, about a source of this name and kind, and the model that the run begins with.

        `open_sink` opens the sink to record into; `messages` is called with the events of recordings, which viewers get
        too. The player is of the recording that is shown, and begins with the first viewer; None if there is none.
        """
        self._messages = messages
        self._recorder.open_sink = open_sink
        self._server.begin(Run(name, kind, model, self._contract, secrets.token_hex(8)), player)

    def show_map(self, state: MapState) -> None:
        """Show a state of the map. Never waits."""
        self._snapshot.map = state
        self._server.wake()

    def _failed(self, why: str) -> None:
        self._messages(Event(time.monotonic_ns(), "trouble", None, why))

    def _tell(self, event: Event) -> None:
        self._messages(event)
        self._snapshot.tell(event, {})
