"""Messages of an MCAP file, one by one, up to the end of its data or to a damage.

A file is not trusted: records are read up to a limit, and a chunk is unpacked up to its stated size.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import BinaryIO, Final, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from firmware_bridge.errors import RecordingError

MOST_RECORD_BYTES: Final = 1 << 25
"""Most bytes of a record, of a chunk unpacked, and of zstd's window: writers make chunks of one to a few megabytes."""
_RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, and times at which it was logged and published
_KINDS: Final = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata}
_Topic = TypeVar("_Topic")
_BROKEN: Final = (
    *(struct.error, McapError, zstandard.ZstdError, ValueError, OverflowError, MemoryError),
    *(EOFError, RuntimeError),  # of lz4
)


class DamageError(Exception):
    """A record cannot be read, so the rest of the file is not read either."""


class CutOffError(DamageError):
    """The file ends too early."""


def messages(
    file: BinaryIO, topic_of: Callable[[Channel, Schema | None], _Topic | None]
) -> Iterator[tuple[_Topic, int, memoryview] | Metadata]:
    """Yield the messages of a file up to the end of its data, those in chunks one by one, and metadata between them.

    A message is its topic, the time at which it was logged in [ns] since 1970, and its data. `topic_of` gives the topic
    for a channel and its schema, None for a channel whose messages are left out.

    Raises:
        RecordingError: it is no MCAP file.
        DamageError: a record cannot be read.
    """
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise RecordingError(f"{file.name}: not an MCAP file: it does not begin as one")
    schemas: dict[int, Schema] = {}
    topics: dict[int, _Topic | None] = {}
    for opcode, data in _undivided(file):
        if opcode == Opcode.MESSAGE:
            if len(data) < _MESSAGE.size:
                raise DamageError("a message that is cut off")
            channel_id, _, log_ns, _ = _MESSAGE.unpack_from(data)
            topic = topics.get(channel_id)
            if topic is not None:
                yield topic, log_ns, data[_MESSAGE.size :]
        elif opcode in _KINDS:
            try:
                record = _KINDS[Opcode(opcode)].read(ReadDataStream(BytesIO(data)))
            except _BROKEN as error:
                raise DamageError(f"a record that cannot be read ({short(error)})") from error
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                topics[record.id] = topic_of(record, schemas.get(record.schema_id))
            else:
                yield record


def _undivided(file: BinaryIO) -> Iterator[tuple[int, memoryview]]:
    """Yield opcodes and content of records, whose lengths are checked by the file's size."""
    size_bytes = os.fstat(file.fileno()).st_size
    while True:
        at = file.tell()
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise CutOffError(f"without an end, at byte {at}")
        opcode, length = _RECORD.unpack(head)
        if length > size_bytes - at - _RECORD.size:
            raise CutOffError(f"within a record, at byte {at}")
        if opcode == Opcode.DATA_END:
            file.seek(length, os.SEEK_CUR)
            _check_alone(file, size_bytes)
            return
        if opcode not in (Opcode.CHUNK, Opcode.MESSAGE, *_KINDS):
            file.seek(length, os.SEEK_CUR)
            continue
        if length > MOST_RECORD_BYTES:
            raise DamageError(f"at byte {at}, a record of {length:,} bytes, expected at most {MOST_RECORD_BYTES:,}")
        data = memoryview(file.read(length))
        if opcode != Opcode.CHUNK:
            yield opcode, data
            continue
        try:
            unpacked = _unpacked(Chunk.read(ReadDataStream(BytesIO(data))))
        except _BROKEN as error:
            raise DamageError(f"at byte {at}, a chunk that cannot be unpacked: {short(error)}") from error
        yield from _records_of(unpacked, at)


def _check_alone(file: BinaryIO, size_bytes: int) -> None:
    """Raise a DamageError where another file follows, as after `cat`; an index between them may be cut off."""
    while len(head := file.read(_RECORD.size)) == _RECORD.size:
        opcode, length = _RECORD.unpack(head)
        end = file.tell() + length + len(MCAP0_MAGIC)
        if opcode == Opcode.FOOTER and end < size_bytes:
            file.seek(end)
            raise DamageError(f"another file follows at byte {end}")
        file.seek(min(file.tell() + length, size_bytes))


def _records_of(chunk: bytes, at: int) -> Iterator[tuple[int, memoryview]]:
    view, position = memoryview(chunk), 0
    while position < len(chunk):
        if len(chunk) - position < _RECORD.size:
            raise DamageError(f"at byte {at}, a chunk that is cut off")
        opcode, length = _RECORD.unpack_from(chunk, position)
        position += _RECORD.size
        if length > len(chunk) - position:
            raise DamageError(f"at byte {at}, a chunk that is cut off")
        yield opcode, view[position : position + length]
        position += length


def _unpacked(chunk: Chunk) -> bytes:
    size_bytes = chunk.uncompressed_size
    if size_bytes > MOST_RECORD_BYTES:
        raise ValueError(f"{size_bytes:,} bytes, expected at most {MOST_RECORD_BYTES:,}")
    if chunk.compression == "zstd":
        unpacker = zstandard.ZstdDecompressor(max_window_size=MOST_RECORD_BYTES)
        data = unpacker.stream_reader(chunk.data).read(size_bytes + 1)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size_bytes + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"compressed by {chunk.compression[:20]!r}, expected zstd, lz4 or nothing")
    if len(data) != size_bytes:
        raise ValueError(f"it does not hold the {size_bytes:,} bytes that it states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its check sum is wrong")
    return data


def short(error: BaseException) -> str:
    """Return the text of an error in one line."""
    return " ".join(str(error).split())[:120] or type(error).__name__
