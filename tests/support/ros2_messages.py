"""ROS 2 messages by ROS's own definitions, which the package rosbags carries: DDS types, hashes and decoding."""

from functools import cache

import numpy as np
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, byte, float32, float64, int8, int32, sequence, uint8, uint32
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

ROS = get_typestore(Stores.ROS2_JAZZY)
IDL = {
    "int8": int8,
    "int32": int32,
    "uint32": uint32,
    "uint8": uint8,
    "octet": byte,
    "byte": byte,
    "bool": bool,
    "float32": float32,
    "float64": float64,
    "string": str,
}


def fields(name):
    """Return name, type, and True for a sequence or the length of an array, of each field."""
    found = []
    for field, (node, what) in ROS.fielddefs[name][1]:
        many = False
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (inner, what), length = what
            many = length if node == Nodetype.ARRAY else True
            node = inner
        found.append((field, what if node == Nodetype.NAME else what[0], many))
    return found


@cache
def dds_type(name):
    """Return the DDS type of a message, named as by rmw_cyclonedds."""
    package, _, message = name.split("/")
    members = {}
    for field, kind, many in fields(name):
        single = IDL[kind] if kind in IDL else dds_type(kind)
        members[field] = sequence[single] if many is True else array[single, many] if many else single
    return final(make_idl_struct(message, f"{package}.msg.dds_.{message}_", members))


def built(name, message):
    """Return a message, of nested dicts and lists by the names of its fields, as an instance of its DDS type."""
    values = {}
    for field, kind, many in fields(name):
        value = message[field]
        if kind not in IDL:
            value = [built(kind, one) for one in value] if many else built(kind, value)
        values[field] = value
    return dds_type(name)(**values)


def type_hash(name):
    """Return the hash RIHS01 of a type."""
    return ROS.hash_rihs01(name).removeprefix("RIHS01_")


def decode(name, data):
    """Decode a message from plain little-endian CDR, by ROS's definitions alone; all of `data` is used."""
    assert data[:4] == b"\x00\x01\x00\x00"
    return plain(ROS.deserialize_cdr(data, name))


def plain(value):
    """Return a message as nested dicts and lists."""
    if hasattr(value, "__msgtype__"):
        return {key: plain(one) for key, one in vars(value).items() if key != "__msgtype__"}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(one) for one in value] if isinstance(value, list) else value
