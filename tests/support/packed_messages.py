"""Reader of the messages that the live page and zenoh carry, by the layout in docs/middleware.md alone."""

import json
from math import prod
from struct import unpack_from

import numpy as np


def unpack(message):
    """Return header and maps of a message; an AssertionError where it is longer or shorter than its header says."""
    (length,) = unpack_from("<I", message)
    header, at, maps = json.loads(message[4 : 4 + length]), 4 + length, {}
    assert at % 4 == 0
    for name, shape in header["maps"]:
        maps[name] = np.frombuffer(message, "<f4", prod(shape), at).reshape(shape)
        at += maps[name].nbytes
    assert at == len(message)
    return header, maps
