"""Recordings played for a person: at any speed, paused, from any place, again and again."""

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from firmware_bridge.links.base import Notice
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import NS_PER_S, Clock

SLOWEST: Final = 0.05
FASTEST: Final = 4.0
"""Largest speed: two sensors at 100 scans/s are then 800 scans/s, which every scan's inference can follow."""
JUMP_NS: Final = NS_PER_S // 3
"""Time between the scans before and after a jump, in [ns]: times of scans never fall, and nothing lies in between."""


class PlayerState(NamedTuple):
    """State of a player."""

    at_s: float  # place of the newest scan, in [s] since the first of the recording
    length_s: float  # place of the last scan
    speed: float  # seconds of the recording in a second
    paused: bool  # True while nothing is played
    waiting: bool  # True until somebody looks
    rounds: int  # complete rounds so far

    @property
    def rests(self) -> bool:
        """True while no scan is due, however long it takes."""
        return self.paused or self.waiting


class Player:
    """Controls of a played recording; any thread may use them. It waits until `begin`."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._state = PlayerState(0.0, 0.0, 1.0, paused=False, waiting=True, rounds=0)
        self._jump_s: float | None = None

    @property
    def state(self) -> PlayerState:
        """State now."""
        return self._state

    def begin(self) -> None:
        """Play, now that somebody looks."""
        self._set(waiting=False)

    def pause(self, *, on: bool) -> None:
        """Pause, or go on."""
        self._set(paused=on)

    def set_speed(self, speed: float) -> None:
        """Play at a speed, within SLOWEST and FASTEST."""
        self._set(speed=min(max(speed, SLOWEST), FASTEST))

    def jump(self, at_s: float) -> None:
        """Go on from a place, in [s] since the first scan; a paused player shows it."""
        with self._changed:
            self._jump_s = min(max(at_s, 0.0), self._state.length_s)
            self._changed.notify_all()

    def wait(self, timeout_s: float) -> None:
        """Wait for a change of the controls."""
        with self._changed:
            if self._jump_s is None:
                self._changed.wait(timeout_s)

    def take_jump(self) -> float | None:
        """Return the place to go on from, once."""
        with self._changed:
            jump_s, self._jump_s = self._jump_s, None
            return jump_s

    def reach(self, at_s: float, length_s: float, rounds: int) -> None:
        """Note the place that is played."""
        with self._changed:
            self._state = self._state._replace(at_s=at_s, length_s=length_s, rounds=rounds)

    def _set(self, **changes: Any) -> None:
        with self._changed:
            self._state = self._state._replace(**changes)
            self._changed.notify_all()


class PlayedReplay(ReplayLink):
    """Link to recordings that a player controls, endless; scans have their recorded times, which go on at a jump.

    It is patient, so that every scan is played, and its results are the same at any speed.
    """

    def __init__(
        self,
        paths: Sequence[str | Path],
        player: Player,
        rate_hz: float | None = None,
        *,
        clock: Clock = time.monotonic_ns,
    ) -> None:
        """Load the recordings; arguments and errors are those of ReplayLink."""
        super().__init__(paths, rate_hz, paced=True, clock=clock)
        self.patient = True
        self.unix_offset_ns = self.recordings[0].unix_offset_ns
        self._player = player
        self._length_s = int(self._due_ns[-1]) / NS_PER_S
        self._numbers = [0] * len(self._tracks)
        self._last_ns = self.first_ns
        self._anchor: tuple[int, int, float] | None = None  # wall time and time of a scan, and the speed from there on
        self._jumped: list[Notice] = []
        self._shown = 0  # scans still to be shown at once, one of each sensor, since a paused player jumped
        self._rounds = 0
        player.reach(0.0, self._length_s, 0)

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the next scan once it is due at the player's speed; nothing if that takes longer, or it rests."""
        player = self._player
        jump_s = player.take_jump()
        if jump_s is not None:
            self._jump(round(jump_s * NS_PER_S))
            self._shown = len(self._tracks)
        elif player.state.rests and not self._shown:
            self._anchor = None
            player.wait(timeout_s)
            return []
        elif self._place == len(self._due_ns):
            self._rounds += 1
            self._jump(0)
        if self._shown:
            self._shown -= 1
            return [self._play()]
        next_ns, now_ns, speed = self._next_ns() or 0, self._clock(), player.state.speed
        if self._anchor is None or self._anchor[2] != speed:
            self._anchor = now_ns, next_ns, speed
        wall_ns, scan_ns, _ = self._anchor
        wait_ns = wall_ns + round((next_ns - scan_ns) / speed) - now_ns
        if wait_ns > 0:
            player.wait(min(wait_ns / NS_PER_S, timeout_s))
            if player.state.rests or self._clock() < now_ns + wait_ns:
                return []
        return [self._play()]

    def notices(self) -> list[Notice]:
        """Return the notes on the files, and the jumps, each once."""
        jumped, self._jumped = self._jumped, []
        return [*super().notices(), *jumped]

    def _play(self) -> Scan:
        """Return the next scan, with a number that no scan before it had."""
        lane = int(self._lane[self._place])
        scan = self._take()
        self.ended = False
        self._last_ns = scan.time_ns
        self._numbers[lane] += 1
        self._player.reach((scan.time_ns - self.first_ns) / NS_PER_S, self._length_s, self._rounds)
        return replace(scan, number=self._numbers[lane] - 1)

    def _jump(self, due_ns: int) -> None:
        """Go on from a place; the times of scans go on as well."""
        self._place = min(int(self._due_ns.searchsorted(due_ns)), len(self._due_ns) - 1)
        due_ns = int(self._due_ns[self._place])
        self.first_ns = self._last_ns + JUMP_NS - due_ns
        for poses in self._pose_lanes:
            poses.begin_at(due_ns)
        self._anchor = None
        self._jumped = [Notice(self._last_ns, "back", "")]
