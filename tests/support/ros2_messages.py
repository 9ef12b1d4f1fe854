"""ROS 2 messages as their .msg files define them, without comments: DDS types and type hashes made of the text."""

import hashlib
import json
import struct
from functools import cache

from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, byte, float64, int32, sequence, uint8, uint32

DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/msg/String": "string data",
    "sensor_msgs/msg/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Wrench": "Vector3 force\nVector3 torque",
    "geometry_msgs/msg/WrenchStamped": "std_msgs/Header header\nWrench wrench",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/msg/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\nPose pose",
    "geometry_msgs/msg/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "std_msgs/Header header\nPoseWithCovariance pose",
    "geometry_msgs/msg/Transform": "Vector3 translation\nQuaternion rotation",
    "geometry_msgs/msg/TransformStamped": "std_msgs/Header header\nstring child_frame_id\nTransform transform",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "diagnostic_msgs/msg/KeyValue": "string key\nstring value",
    "diagnostic_msgs/msg/DiagnosticStatus": "byte level\nstring name\nstring message\nstring hardware_id\n"
    "KeyValue[] values",
    "diagnostic_msgs/msg/DiagnosticArray": "std_msgs/Header header\nDiagnosticStatus[] status",
}
IDL = {"int32": int32, "uint32": uint32, "uint8": uint8, "byte": byte, "float64": float64, "string": str}
CODES = {"int32": "i", "uint32": "I", "uint8": "B", "byte": "B", "float64": "d"}
TYPE_IDS = {"uint8": 3, "int32": 6, "uint32": 7, "float64": 11, "byte": 16, "string": 17}
NESTED, UNBOUNDED = 1, 144


def fields(name):
    """Return name, type, and True for a sequence or the length of an array, of each field.

    A type of the same package may stand without it.
    """
    found = []
    for line in DEFINITIONS[name].splitlines():
        kind, field = line.split()
        kind, bracket, length = kind.removesuffix("]").partition("[")
        many = int(length) if length else bool(bracket)
        if kind not in IDL:
            package, _, message = kind.rpartition("/")
            kind = f"{package or name.split('/')[0]}/msg/{message}"
        found.append((field, kind, many))
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
    """Return the hash RIHS01, by REP-2011: the SHA-256 of the type's description and of all that it refers to."""
    below = set()

    def refer(one):
        for _, kind, _ in fields(one):
            if kind not in IDL and kind not in below:
                below.add(kind)
                refer(kind)

    def describe(one):
        described = []
        for field, kind, many in fields(one):
            number = TYPE_IDS.get(kind, NESTED) + (UNBOUNDED if many else 0)
            nested = "" if kind in IDL else kind
            what = {"type_id": number, "capacity": 0, "string_capacity": 0, "nested_type_name": nested}
            described.append({"name": field, "type": what})
        return {"type_name": one, "fields": described}

    refer(name)
    said = {"type_description": describe(name), "referenced_type_descriptions": [describe(b) for b in sorted(below)]}
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()


def decode(name, data):
    """Decode a message from plain little-endian CDR, by the rules alone; all of `data` is used."""
    assert data[:4] == b"\x00\x01\x00\x00"
    body, position = data[4:], 0

    def take(code):
        nonlocal position
        size = struct.calcsize(code)
        position += -position % size
        (value,) = struct.unpack_from(f"<{code}", body, position)
        position += size
        return value

    def single(kind):
        nonlocal position
        if kind == "string":
            length = take("I")
            text = body[position : position + length]
            position += length
            assert text.endswith(b"\0")
            return text[:-1].decode()
        return take(CODES[kind]) if kind in CODES else message(kind)

    def message(one):
        return {
            field: [single(kind) for _ in range(take("I") if many is True else many)] if many else single(kind)
            for field, kind, many in fields(one)
        }

    decoded = message(name)
    assert len(body) - position < 4 and not any(body[position:])
    return decoded
