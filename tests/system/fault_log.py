"""Files of the injector's truth, for the evaluation of a reader in another process."""

import json
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np
from fault_injector import Injector
from fault_stretches import Stretch
from fault_truth import ROW, Truth
from numpy.typing import NDArray

FRAMES: Final = "frames.bin"
EVENTS: Final = "events.jsonl"
ACCOUNTS: Final = "accounts.json"


class TruthFiles:
    """Writer of a folder with every frame and its fate, begin and end of faults, and at the end the accounts."""

    def __init__(self, folder: Path) -> None:
        """Store the folder; nothing is written yet."""
        self._folder = folder
        self._open = ExitStack()
        self._injector: Injector | None = None

    def __enter__(self) -> Self:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._frames = self._open.enter_context((self._folder / FRAMES).open("wb"))
        self._events = self._open.enter_context((self._folder / EVENTS).open("w", buffering=1))
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._open.close()
        if self._injector is not None:
            truth = self._injector.truth
            accounts = {
                "counters": truth.counters(),
                "fates": dict(truth.fates),
                "begun": dict(self._injector.begun),
                "openings": truth.openings,
                "noise": truth.noise,
            }
            (self._folder / ACCOUNTS).write_text(json.dumps(accounts))

    def injector(self, stretches: Sequence[Stretch], seed: int) -> Injector:
        """Return an injector whose truth is written to the folder."""
        self._injector = Injector(stretches, Truth(self._frames.write), seed, tell=self._tell)
        return self._injector

    def _tell(self, what: str, stretch: Stretch) -> None:
        event = {"time_ns": time.monotonic_ns(), "what": what, "fault": stretch.name, "stretch": str(stretch)}
        self._events.write(json.dumps(event) + "\n")


class Told(NamedTuple):
    """Content of a folder: frames as ROW, in the order in which they were handed on; events; accounts."""

    frames: NDArray[Any]
    events: list[dict[str, Any]]
    accounts: dict[str, Any]


def read_truth(folder: Path) -> Told:
    """Read the folder of an emulator that has ended."""
    return Told(
        np.fromfile(folder / FRAMES, dtype=ROW),
        [json.loads(line) for line in (folder / EVENTS).read_text().splitlines()],
        json.loads((folder / ACCOUNTS).read_text()),
    )
