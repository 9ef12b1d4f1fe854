"""ROS 2 messages by ROS's own definitions, which the package rosbags carries: DDS types, hashes and decoding.

    python ros2_messages.py DOMAIN {"topic": "sensor_msgs/msg/Image", ...} [best-effort] [signed-bytes]

subscribes as a ROS node would, and prints a line of JSON for each message. With signed-bytes it describes bytes in
another way than ROS's definitions, as Fast DDS does.
"""

import dataclasses
import json
import sys
import time
from functools import cache

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.idl.annotations import final
from cyclonedds.internal import InvalidSample
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS = get_typestore(Stores.ROS2_JAZZY)
FOXGLOVE = {  # as https://docs.ros.org/en/api/foxglove_msgs/html/msg/Grid.html states them
    "Vector2": "float64 x\nfloat64 y",
    "PackedElementField": "string name\nuint32 offset\nuint8 type",
    "Grid": "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\nuint32 column_count\n"
    "foxglove_msgs/Vector2 cell_size\nuint32 row_stride\nuint32 cell_stride\n"
    "foxglove_msgs/PackedElementField[] fields\nuint8[] data",
}
for _name, _text in FOXGLOVE.items():
    ROS.register(get_types_from_msg(_text, f"foxglove_msgs/msg/{_name}"))
IDL = {kind: getattr(types, kind) for kind in ("int8", "int32", "uint32", "uint8", "byte", "float32", "float64")}
IDL |= {"octet": types.byte, "bool": bool, "string": str}


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
        members[field] = types.sequence[single] if many is True else types.array[single, many] if many else single
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


def decode(name, data):
    """Decode a message from plain little-endian CDR, by ROS's definitions alone."""
    assert data[:4] == b"\x00\x01\x00\x00"
    return heard(dds_type(name).deserialize(data))


def heard(value):
    """Return a message as nested dicts and lists, bytes in hexadecimal."""
    if dataclasses.is_dataclass(value):
        return {field.name: heard(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, list) and value and isinstance(value[0], int):
        return bytes(one & 0xFF for one in value).hex()
    return [heard(one) for one in value] if isinstance(value, list) else value


def main(domain, topics, best_effort):
    participant, readers = DomainParticipant(domain), {}
    reliability = Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(0)
    # As rclpy and rmw_cyclonedds ask for: volatile but for static frames, keep last, and plain CDR alone.
    history = Policy.History.KeepLast(5 if best_effort else 10)
    cdr = Policy.DataRepresentation(use_cdrv0_representation=True)
    for topic, name in topics.items():
        durability = Policy.Durability.TransientLocal if topic == "tf_static" else Policy.Durability.Volatile
        about = Topic(participant, f"rt/{topic}", dds_type(name))
        readers[topic] = DataReader(participant, about, Qos(reliability, durability, history, cdr))
    print(json.dumps({"topic": "listening"}), flush=True)
    while True:
        for topic, reader in readers.items():
            for message in reader.take(N=100):
                if isinstance(message, InvalidSample):  # its writer has gone
                    continue
                print(json.dumps({"topic": topic, "message": heard(message)}), flush=True)
        time.sleep(0.002)


if __name__ == "__main__":
    if "signed-bytes" in sys.argv:
        IDL["uint8"] = types.int8
    main(int(sys.argv[1]), json.loads(sys.argv[2]), "best-effort" in sys.argv)
