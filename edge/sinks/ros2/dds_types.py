"""DDS types of ROS 2 messages, made of the definitions that encode them.

All are final, so that they are encoded as plain CDR.
"""

from functools import cache
from typing import Any, Final

from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.idl.annotations import final

from firmware_bridge.recording.cdr import Field, MessageType

TYPE_HASHES: Final[dict[str, str]] = {
    "geometry_msgs/msg/PointStamped": "4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "std_msgs/msg/Float64": "705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
    "std_msgs/msg/Int8": "26525065a403d972cb672f0777e333f0c799ad444ae5fcd79e43d1e73bd0f440",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
"""SHA-256 of each type's description, as ROS makes it (RIHS01); from Iron on ROS warns of publishers without one."""


@cache
def dds_type(kind: MessageType) -> type[IdlStruct]:
    """Return the DDS type of a message, named as ROS names it; an instance holds the encoded message."""
    package, _, name = kind.name.split("/")
    members = {field.name: _member(field) for field in kind.fields}
    made: Any = make_idl_struct(name, f"{package}.msg.dds_.{name}_", members, dataclassify=False)
    made.__init__ = _hold
    made.serialize = _held  # called by a writer in place of its own encoder
    made.deserialize = made.deserialize_key = classmethod(_received)  # and by a reader
    return final(made)


def _hold(self: Any, encoded: bytes) -> None:
    self.encoded = encoded


def _held(self: Any, **_: object) -> bytes:
    return self.encoded


def _received(cls: Any, data: bytes, **_: object) -> Any:
    return cls(data)


def _member(field: Field) -> Any:
    if field.message is not None:
        single = dds_type(field.message)
    else:
        single = {"string": str, "bool": bool}.get(field.kind) or getattr(types, field.kind)
    if field.length:
        return types.array[single, field.length]
    return single if field.length is None else types.sequence[single]
