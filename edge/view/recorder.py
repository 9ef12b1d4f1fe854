"""Recorder that begins and ends a recording while the run goes on."""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from threading import get_native_id
from typing import Final

from edge.errors import SinkError
from edge.perception.event import Event, EventKind
from edge.perception.result import Result
from edge.pipeline.sink import Sink
from firmware_bridge.poses import TimedPose

FORM: Final = "mcap"  # form of the sink that is recorded into, and the ending of its files


class Recorder(Sink):
    """Recorder into a new file for each recording; a failure is reported as an event, and does not end the run.

    A thread of its own opens and closes the file, so that the run never waits for a disk: scans that come before the
    file is open are not recorded. The thread starts in the constructor, because one that the loop starts later would
    inherit the loop's processor. Threads that a sink starts inherit this thread's processors.

    Attributes:
        path: of the file that is recorded into; None while there is no recording.
        open_sink: opens the sink that a text names; to be set before anything is recorded.
    """

    def __init__(
        self,
        directory: Path,
        tell: Callable[[Event], object],
        local_time: Callable[[], time.struct_time] = time.localtime,
    ) -> None:
        """Start the thread; what begins, ends and fails is told as events, and `local_time` names the files."""
        self.path: Path | None = None
        self.open_sink: Callable[[str], Sink] | None = None
        self._directory, self._tell, self._local_time = directory, tell, local_time
        self._sink: Sink | None = None
        self._unwritten = 0
        self._aside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recorder")
        self._aside.submit(get_native_id).result()
        self._opening: Future[tuple[Sink, Path]] | None = None
        self._wanted = False
        self._begun_s = 0.0
        self._closing: tuple[Future[None], Path | None] | None = None

    @property
    def unwritten(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Number of records left out, of all recordings."""
        return self._unwritten + (0 if self._sink is None else self._sink.unwritten)

    @property
    def recorded(self) -> tuple[float, int] | None:
        """Length of the recording so far in [s], and size of its file in bytes; None while there is none."""
        path, begun_s = self.path, self._begun_s
        if path is None:
            return None
        try:
            return round(time.monotonic() - begun_s, 1), path.stat().st_size
        except OSError:
            return None  # it was moved or removed meanwhile

    def record(self, on: bool) -> None:
        """Begin a recording, or end it; does nothing where that is so already."""
        self._look_back()
        if on and self._closing is not None:
            self._say("refused", "not recording: the previous file is still being written; try again")
            return
        self._wanted = on
        if on and self._sink is None and self._opening is None and self.open_sink is not None:
            self._opening = self._aside.submit(self._open, self.open_sink)
        elif not on and self._sink is not None:
            self._end(self.path)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Record one result, if a recording is open."""
        self._do(lambda sink: sink.write(result, counters))

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Record an event, if a recording is open."""
        self._do(lambda sink: sink.tell(event, counters))

    def pose(self, poses: Sequence[TimedPose]) -> None:
        """Record poses, if a recording is open."""
        self._do(lambda sink: sink.pose(poses))

    def wait(self) -> None:
        """Pass on that no scan came."""
        self._do(lambda sink: sink.wait())

    def close(self) -> None:
        """End the recording, if there is one, and wait until it is written."""
        if self._opening is not None:
            wait([self._opening])
        self.record(False)
        self._aside.shutdown()
        self._look_back()

    def _open(self, open_sink: Callable[[str], Sink]) -> tuple[Sink, Path]:
        try:
            path = _unused(self._directory / time.strftime("edge-%Y%m%d-%H%M%S", self._local_time()))
        except OSError as error:
            raise SinkError(f"cannot record into {self._directory}: {error.strerror}") from error
        return open_sink(f"{FORM}:{path}"), path

    def _do(self, act: Callable[[Sink], None]) -> None:
        self._look_back()
        if self._sink is None:
            return
        try:
            act(self._sink)
        except SinkError as error:
            self._end(None)
            self._say("sink", f"the recording has ended: {error}")

    def _end(self, whole: Path | None) -> None:
        """Close the file in the thread and then report `whole`, which is None where an error was reported already."""
        sink, self._sink, self.path = self._sink, None, None
        if sink is not None:
            self._unwritten += sink.unwritten
            self._closing = self._aside.submit(sink.close), whole

    def _look_back(self) -> None:
        """Take over what the thread has finished."""
        if self._opening is not None and self._opening.done():
            self._begin(self._opening)
        if self._closing is None or not self._closing[0].done():
            return
        (closed, whole), self._closing = self._closing, None
        try:
            closed.result()
        except SinkError as error:
            self._say("sink", f"the recording could not be finished: {error}")
            return
        if whole is not None:
            self._say("note", f"recorded into {whole}")

    def _begin(self, opened: Future[tuple[Sink, Path]]) -> None:
        self._opening = None
        try:
            self._sink, path = opened.result()
            self._begun_s, self.path = time.monotonic(), path
        except SinkError as error:
            self._say("sink", f"not recording: {error}")
            return
        self._say("note", f"recording into {self.path}")
        if not self._wanted:
            self._end(self.path)

    def _say(self, kind: EventKind, text: str) -> None:
        self._tell(Event(time.monotonic_ns(), kind, None, text))


def _unused(stem: Path) -> Path:
    """Return a file name from this stem, with a number if needed, that does not exist yet."""
    path, count = stem.with_name(f"{stem.name}.{FORM}"), 1
    while path.exists():
        count += 1
        path = stem.with_name(f"{stem.name}-{count}.{FORM}")
    return path
