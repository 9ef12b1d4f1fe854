"""Binary message of a JSON header and float32 maps, as the live page and zenoh carry it.

    4 bytes     n, length of the header, little-endian
    n bytes     header, JSON in UTF-8, padded with spaces until 4 + n is a multiple of 4
    the rest    maps, float32 little-endian in C order, one after the other

The header's "maps" lists them: [[name, [size, ...]], ...].
"""

import math
import struct
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from edge.errors import MessageError

_LENGTH: Final = struct.Struct("<I")
_FLOAT32: Final = np.dtype("<f4")


def pack(header: Mapping[str, Any], maps: Mapping[str, NDArray[np.floating]]) -> bytes:
    """Return one message of a header, of what JSON can hold and arrays, and of maps of any shape by name."""
    listed = [[name, values.shape] for name, values in maps.items()]
    text = orjson.dumps({**header, "maps": listed}, option=orjson.OPT_SERIALIZE_NUMPY)
    text += b" " * (-(_LENGTH.size + len(text)) % _FLOAT32.itemsize)
    arrays = (np.ascontiguousarray(values, dtype=_FLOAT32).tobytes() for values in maps.values())
    return b"".join((_LENGTH.pack(len(text)), text, *arrays))


def unpack(message: bytes) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """Return header and maps, read-only views, of a message; a MessageError where the bytes are none."""
    try:
        (length,) = _LENGTH.unpack_from(message)
        header = orjson.loads(message[_LENGTH.size : _LENGTH.size + length])
        listed = [(str(name), tuple(map(int, shape))) for name, shape in header["maps"]]
    except (struct.error, ValueError, TypeError, KeyError, OverflowError) as error:
        raise MessageError(f"{len(message)} bytes are not a packed message: expected a header with its maps") from error
    position, maps = _LENGTH.size + length, {}
    for name, shape in listed:
        count = math.prod(shape)
        end = position + count * _FLOAT32.itemsize
        if min(shape, default=1) < 0 or end > len(message):
            raise MessageError(f"map {name!r} is {shape}, which is not what {len(message)} bytes hold")
        maps[name] = np.frombuffer(message, _FLOAT32, count, position).reshape(shape)
        position = end
    if position != len(message):
        raise MessageError(f"{len(message) - position} bytes after the last map, expected none")
    return header, maps
