"""Writer of an MCAP file that stays whole up to the last quarter of a second, however its process ends.

The public Writer closes a chunk by its size alone unless asked to, compresses in the caller's thread, and keeps a
large object for each chunk until the end, which over a day of small chunks is hundreds of megabytes. This writer is
made of the package's public records; it compresses and writes in a thread of its own, so that no caller waits.
"""

import os
import struct
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Final

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

CHUNK_S: Final = 0.25
"""Longest stretch that a crash costs, in [s]; a power cut also costs what the system had not put on the disk yet."""
MOST_CHUNK_BYTES: Final = 1 << 22
MOST_WAITING_BYTES: Final = 1 << 24
"""Most bytes that wait, before compression: five seconds of two sensors' patterns while the disk is busy elsewhere."""
_LEVEL: Final = 1
"""Level of zstd: the next levels take twice the time for some percent of noise."""
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS_BYTES: Final = 22
_FOOTER_BYTES: Final = 20
_PART_BYTES: Final = 1 << 16


class McapFile:
    """Writer of schemas, channels, messages and metadata into one new file.

    Attributes:
        messages: number of messages added so far.
        written: number of messages on the disk, by channel.
        size_bytes: size on the disk so far.
    """

    def __init__(self, path: Path, profile: str, library: str, clock_s: Callable[[], float] = time.monotonic) -> None:
        """Begin the file.

        Args:
            path: of the file, which must not exist yet.
            profile: of MCAP, such as "ros2".
            library: name of the library that writes the file.
            clock_s: monotonic, in [s].

        Raises:
            OSError: the file cannot be written; FileExistsError if it exists.
        """
        # The index of the chunks grows by megabytes an hour, so it waits on the disk, in a file without a name.
        self._chunks = TemporaryFile(dir=path.parent)  # noqa: SIM115 - `abandon` closes it
        self._file = path.open("xb", buffering=0)
        self.size_bytes = 0
        self._clock_s = clock_s
        self._head = RecordBuilder()
        self._head.write(MCAP0_MAGIC)
        Header(profile, library).write(self._head)
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._counts: dict[int, int] = {}
        self.written: dict[int, int] = {}
        self._first_ns = self._last_ns = 0
        self._metadata = RecordBuilder()
        self._metadata_count = 0
        self._chunk_count = 0
        self._payload = bytearray()
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._times_ns: tuple[int, int] = (0, 0)
        self._due_s = 0.0
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="mcap-writer")
        self._handed_over: deque[tuple[Future[None], int]] = deque()
        self._waiting_bytes = 0
        self._failed = False

    @property
    def messages(self) -> int:  # noqa: D102 - above
        return sum(self._counts.values())

    def add_schema(self, name: str, encoding: str, text: str) -> int:
        """Add a schema and return its id."""
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=text.encode())
        self._schemas.append(schema)
        schema.write(self._head)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a channel and return its id."""
        number = len(self._channels) + 1
        channel = Channel(id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=dict(metadata))
        self._channels.append(channel)
        channel.write(self._head)
        return number

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add facts that hold for the whole file, and pass them to the writing thread at once.

        Raises:
            OSError: an earlier record cannot be written.
        """
        self._flush()
        self._hand_over(0, self._write_metadata, name, _bytes_of(Metadata(name=name, metadata=dict(values))))

    def add_message(self, channel: int, unix_ns: int, data: bytes) -> None:
        """Add one message; it is passed to the writing thread within CHUNK_S, if `look` is called by then.

        Raises:
            OSError: an earlier record cannot be written.
        """
        sequence = self._counts.get(channel, 0)
        if not self._payload:
            self._times_ns = (unix_ns, unix_ns)
            self._due_s = self._clock_s() + CHUNK_S
        self._index.setdefault(channel, []).append((unix_ns, len(self._payload)))
        self._payload += _MESSAGE.pack(
            Opcode.MESSAGE, _MESSAGE_FIELDS_BYTES + len(data), channel, sequence & 0xFFFFFFFF, unix_ns, unix_ns
        )
        self._payload += data
        self._times_ns = (min(self._times_ns[0], unix_ns), max(self._times_ns[1], unix_ns))
        self._first_ns = unix_ns if not self._counts else min(self._first_ns, unix_ns)
        self._last_ns = max(self._last_ns, unix_ns)
        self._counts[channel] = sequence + 1
        if len(self._payload) >= MOST_CHUNK_BYTES:
            self._flush()

    def full(self) -> bool:
        """Return True if so much waits for the disk that nothing should be added.

        Raises:
            OSError: an earlier record cannot be written.
        """
        self._look_back()
        return self._waiting_bytes + len(self._payload) >= MOST_WAITING_BYTES

    def look(self) -> None:
        """Close the chunk if it is due.

        Raises:
            OSError: an earlier record cannot be written.
        """
        self._look_back()
        if self._payload and self._clock_s() >= self._due_s:
            self._flush()

    def close(self) -> None:
        """Write the rest, and the summary that lets a reader seek in the file.

        Raises:
            OSError: the rest cannot be written. The file is closed, and its content can be read.
        """
        try:
            self._flush()
            self._hand_over(0, self._write_summary)
            self.drain()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._executor.shutdown()
        self._file.close()
        with suppress(OSError):  # the index of chunks is of no use any more
            self._chunks.close()

    def drain(self) -> None:
        """Wait until only the open chunk is not on the disk yet.

        Raises:
            OSError: a record cannot be written.
        """
        while self._handed_over:
            self._handed_over[0][0].exception()
            self._look_back()

    def _flush(self) -> None:
        head, self._head = self._head.end(), RecordBuilder()
        payload, self._payload = self._payload, bytearray()
        index, self._index = self._index, {}
        self._hand_over(len(payload), self._write, head, payload, index, self._times_ns)

    def _hand_over(self, waiting_bytes: int, write: Callable[..., None], *given: object) -> None:
        """Queue a job for the writing thread, which works in order and writes nothing more after a failure."""
        self._look_back()
        self._handed_over.append((self._executor.submit(self._unless_failed, write, *given), waiting_bytes))
        self._waiting_bytes += waiting_bytes

    def _look_back(self) -> None:
        while self._handed_over and self._handed_over[0][0].done():
            writing, waiting_bytes = self._handed_over.popleft()
            self._waiting_bytes -= waiting_bytes
            writing.result()

    def _unless_failed(self, write: Callable[..., None], *given: object) -> None:
        if not self._failed:
            write(*given)

    def _write_metadata(self, name: str, record: bytes) -> None:
        MetadataIndex(offset=self.size_bytes, length=len(record), name=name).write(self._metadata)
        self._metadata_count += 1
        self._put(record)

    def _write(
        self, head: bytes, payload: bytearray, index: Mapping[int, list[tuple[int, int]]], times_ns: tuple[int, int]
    ) -> None:
        if head:
            self._put(head)
        if not payload:
            return
        compressed = self._compressor.compress(payload)  # does not hold the interpreter
        chunk = _bytes_of(
            Chunk(
                compression="zstd",
                data=compressed,
                message_start_time=times_ns[0],
                message_end_time=times_ns[1],
                uncompressed_crc=zlib.crc32(payload),
                uncompressed_size=len(payload),
            )
        )
        indexes = RecordBuilder()
        offsets: dict[int, int] = {}
        for channel, records in index.items():
            offsets[channel] = self.size_bytes + len(chunk) + indexes.count
            MessageIndex(channel_id=channel, records=records).write(indexes)
        index_bytes = indexes.end()
        chunk_index = ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=self.size_bytes,
            compression="zstd",
            compressed_size=len(compressed),
            message_end_time=times_ns[1],
            message_index_length=len(index_bytes),
            message_index_offsets=offsets,
            message_start_time=times_ns[0],
            uncompressed_size=len(payload),
        )
        self._put(chunk + index_bytes)
        self._chunks.write(_bytes_of(chunk_index))
        self._chunk_count += 1
        for channel, records in index.items():
            self.written[channel] = self.written.get(channel, 0) + len(records)

    def _put(self, data: bytes) -> None:
        """Write all of the data or nothing: a disk that fills takes a part and refuses the rest."""
        left = memoryview(data)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            self._failed = True
            os.ftruncate(self._file.fileno(), self.size_bytes)
            raise
        self.size_bytes += len(data)

    def _write_summary(self) -> None:
        """Write the whole summary or nothing."""
        whole_bytes = self.size_bytes
        try:
            self._put(_bytes_of(DataEnd(data_section_crc=0)))
            start, crc = self.size_bytes, 0
            offsets = RecordBuilder()
            for opcode, group in self._summary():
                group_start = self.size_bytes
                for part in group:
                    self._put(part)
                    crc = zlib.crc32(part, crc)
                if self.size_bytes > group_start:
                    length = self.size_bytes - group_start
                    SummaryOffset(group_opcode=opcode, group_start=group_start, group_length=length).write(offsets)
            offsets_start, tail = self.size_bytes, offsets.end()
            head = struct.pack("<BQQQ", Opcode.FOOTER, _FOOTER_BYTES, start, offsets_start)
            crc = zlib.crc32(head, zlib.crc32(tail, crc))
            footer = Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc)
            self._put(tail + _bytes_of(footer) + MCAP0_MAGIC)
        except OSError:
            self.size_bytes = whole_bytes
            os.ftruncate(self._file.fileno(), whole_bytes)
            raise

    def _summary(self) -> Iterator[tuple[Opcode, Iterable[bytes]]]:
        """Yield groups of records, each in parts that fit into memory."""
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunk_count,
            message_count=self.messages,
            message_start_time=self._first_ns,
            message_end_time=self._last_ns,
            metadata_count=self._metadata_count,
            schema_count=len(self._schemas),
        )
        yield Opcode.SCHEMA, map(_bytes_of, self._schemas)
        yield Opcode.CHANNEL, map(_bytes_of, self._channels)
        yield Opcode.STATISTICS, [_bytes_of(statistics)]
        self._chunks.seek(0)
        yield Opcode.CHUNK_INDEX, iter(lambda: self._chunks.read(_PART_BYTES), b"")
        yield Opcode.METADATA_INDEX, [self._metadata.end()]


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
