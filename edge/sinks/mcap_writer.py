"""File of an MCAP recording that stays whole up to the last second, however its process ends.

The public writer makes the records. What it makes is put on the disk in a thread of its own, a whole chunk or nothing,
so that no caller waits, and a disk that fills leaves a file that can be played.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final

from mcap.writer import Writer

CHUNK_S: Final = 1.0
"""Longest stretch that a crash costs, in [s]; the index of chunks, 3 MB an hour and sensor, stays in memory."""
MOST_CHUNK_BYTES: Final = 1 << 22
MOST_WAITING_BYTES: Final = 1 << 24
"""Most bytes that wait, before compression: five seconds of two sensors' patterns while the disk is busy elsewhere."""


class McapFile:
    """Writer of schemas, channels, messages and metadata into one new file.

    Every method but `abandon` raises an OSError where it, or an earlier record, cannot be written.

    Attributes:
        written: number of messages on the disk, by channel.
    """

    def __init__(self, path: Path, profile: str, library: str, clock_s: Callable[[], float] = time.monotonic) -> None:
        """Begin the file, which must not exist yet, with a profile of MCAP and the name of the library that writes."""
        self._file = path.open("xb", buffering=0)
        self._clock_s = clock_s
        self._made = bytearray()
        self._size_bytes = 0
        self.written: dict[int, int] = {}
        self._schema_count = self._channel_count = 0  # as the public writer numbers them
        self._writer = Writer(self, chunk_size=2 * MOST_CHUNK_BYTES)  # type: ignore[arg-type]  # write, tell and flush
        self._jobs: list[Callable[[], object]] = [partial(self._writer.start, profile, library)]
        self._sequences: dict[int, int] = {}
        self._open_bytes = self._waiting_bytes = 0
        self._due_s: float | None = None
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="mcap-writer")
        self._handed_over: deque[tuple[Future[None], int]] = deque()
        self._failed = False

    @property
    def messages(self) -> int:
        """Number of messages added so far."""
        return sum(self._sequences.values())

    def write(self, data: bytes) -> int:
        """Take bytes of the public writer; they are put on the disk as a whole chunk."""
        self._made += data
        return len(data)

    def tell(self) -> int:
        """Return the place of the next byte of the public writer."""
        return self._size_bytes + len(self._made)

    def flush(self) -> None:
        """Do nothing: `_run` puts the bytes on the disk."""

    def add_schema(self, name: str, encoding: str, text: str) -> int:
        """Add a schema and return its id."""
        self._schema_count += 1
        self._jobs.append(partial(self._writer.register_schema, name, encoding, text.encode()))
        return self._schema_count

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a channel and return its id."""
        self._channel_count += 1
        self._jobs.append(partial(self._writer.register_channel, topic, encoding, schema, dict(metadata)))
        return self._channel_count

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add facts that hold for the whole file, and pass them to the writing thread at once."""
        self._jobs.append(partial(self._writer.add_metadata, name, dict(values)))
        self._hand_over()

    def add_message(self, channel: int, unix_ns: int, data: bytes) -> None:
        """Add one message; it is passed to the writing thread within CHUNK_S, if `look` is called by then."""
        if self._due_s is None:
            self._due_s = self._clock_s() + CHUNK_S
        sequence = self._sequences.get(channel, 0)
        self._jobs.append(partial(self._writer.add_message, channel, unix_ns, data, unix_ns, sequence & 0xFFFFFFFF))
        self._sequences[channel] = sequence + 1
        self._open_bytes += len(data)
        if self._open_bytes >= MOST_CHUNK_BYTES:
            self._hand_over()

    def full(self) -> bool:
        """Return True if so much waits for the disk that nothing should be added."""
        self._look_back()
        return self._waiting_bytes + self._open_bytes >= MOST_WAITING_BYTES

    def look(self) -> None:
        """Close the chunk if it is due."""
        self._look_back()
        if self._due_s is not None and self._clock_s() >= self._due_s:
            self._hand_over()

    def close(self) -> None:
        """Write the rest, and the summary that lets a reader seek in the file; closed, and readable, if that fails."""
        try:
            self._hand_over()
            self._jobs.append(self._writer.finish)
            self._hand_over()
            self.drain()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._executor.shutdown()
        self._file.close()

    def drain(self) -> None:
        """Wait until only the open chunk is not on the disk yet."""
        while self._handed_over:
            self._handed_over[0][0].exception()
            self._look_back()

    def _hand_over(self) -> None:
        """Pass what was added to the writing thread, which works in order and writes nothing more after a failure."""
        self._look_back()
        jobs, waiting_bytes = self._jobs, self._open_bytes
        self._jobs, self._open_bytes, self._due_s = [], 0, None
        self._handed_over.append((self._executor.submit(self._run, jobs, dict(self._sequences)), waiting_bytes))
        self._waiting_bytes += waiting_bytes

    def _look_back(self) -> None:
        while self._handed_over and self._handed_over[0][0].done():
            writing, waiting_bytes = self._handed_over.popleft()
            self._waiting_bytes -= waiting_bytes
            writing.result()

    def _run(self, jobs: list[Callable[[], object]], written: dict[int, int]) -> None:
        if self._failed:
            return
        for job in jobs:
            job()
        if self._writer.finish not in jobs:
            self._writer.flush()
        self.put(self._made)
        self._made.clear()
        self.written = written

    def put(self, data: bytearray) -> None:
        """Write all of the data or nothing: a disk that fills takes a part and refuses the rest."""
        try:
            with memoryview(data) as left:
                done = 0
                while done < len(left):
                    done += self._file.write(left[done:])
        except OSError:
            self._failed = True
            os.ftruncate(self._file.fileno(), self._size_bytes)
            raise
        self._size_bytes += len(data)
