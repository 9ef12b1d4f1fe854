"""Messages of an MCAP file, one by one, up to the end of its data or to a damage.

A file is not trusted: the public reader reads records up to a limit, and a chunk is unpacked only where its frame
states the size that the chunk states.
"""

import os
import struct
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, Final, TypeVar

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from firmware_bridge.errors import RecordingError

MOST_CHUNK_BYTES: Final = 1 << 25  # most bytes of a chunk unpacked: writers make chunks of one to a few megabytes
_MOST_RECORD_BYTES: Final = 1 << 28  # attachments, too, which are not read
_Topic = TypeVar("_Topic")


class DamageError(Exception):
    """A record cannot be read, so the rest of the file is not read either."""


class CutOffError(DamageError):
    """The file ends too early."""


def messages(
    file: BinaryIO, topic_of: Callable[[Channel, Schema | None], _Topic | None]
) -> Iterator[tuple[_Topic, int, bytes] | Metadata]:
    """Yield the messages of a file up to the end of its data, those in chunks one by one, and metadata between them.

    A message is its topic, the time at which it was logged in [ns] since 1970, and its data. `topic_of` gives the topic
    for a channel and its schema, None for a channel whose messages are left out. Raises a RecordingError for another
    file, a DamageError for a record that cannot be read.
    """
    schemas: dict[int, Schema] = {}
    topics: dict[int, _Topic | None] = {}
    for record in _records(file):
        if isinstance(record, Message):
            topic = topics.get(record.channel_id)
            if topic is not None:
                yield topic, record.log_time, record.data
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            topics[record.id] = topic_of(record, schemas.get(record.schema_id))
        elif isinstance(record, Metadata):
            yield record


class _Whole:
    """File that ends early rather than answer with fewer bytes, and takes no memory for more than it holds."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._left = file, os.fstat(file.fileno()).st_size

    def read(self, length: int) -> bytes:
        if not 0 <= length <= self._left:
            raise EndOfFile
        self._left -= length
        return self._file.read(length)


def _records(file: BinaryIO) -> Iterator[McapRecord]:
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise RecordingError(f"{file.name}: not an MCAP file: it does not begin as one")
    file.seek(0)
    at = file.tell()
    whole: Any = _Whole(file)
    try:
        for record in StreamReader(whole, emit_chunks=True, record_size_limit=_MOST_RECORD_BYTES).records:
            yield from _of_chunk(record) if isinstance(record, Chunk) else (record,)
            at = file.tell()
    except EndOfFile as error:
        raise CutOffError(f"after byte {at}") from error
    except (struct.error, McapError, zstandard.ZstdError, ValueError, OverflowError, MemoryError) as error:
        raise DamageError(f"after byte {at}, a record that cannot be read: {short(error)}") from error
    if file.tell() < os.fstat(file.fileno()).st_size:  # as `cat` leaves it
        raise DamageError(f"another file follows at byte {file.tell()}")


def _of_chunk(chunk: Chunk) -> list[McapRecord]:
    stated = chunk.uncompressed_size
    if stated > MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk of {stated:,} bytes, expected at most {MOST_CHUNK_BYTES:,}")
    if chunk.compression not in ("zstd", ""):
        raise ValueError(f"compressed by {chunk.compression[:20]!r}, expected zstd or nothing")
    # The frame's own size is what is allocated; -1 where it states none, and the chunk's is the limit.
    own = zstandard.frame_content_size(chunk.data) if chunk.compression else len(chunk.data)
    if own not in (stated, -1):
        raise ValueError(f"a chunk that does not hold the {stated:,} bytes that it states")
    try:
        return breakup_chunk(chunk, validate_crc=True)
    except EndOfFile as error:
        raise ValueError("a chunk that is cut off") from error


def short(error: BaseException) -> str:
    """Return the text of an error in one line."""
    return " ".join(str(error).split())[:120] or type(error).__name__
