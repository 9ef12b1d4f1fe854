"""Types of ROS 2 messages, as ROS's interface definitions have them (Apache-2.0), without their comments."""

from typing import Any, Final

from firmware_bridge.recording.cdr import STD_HEADER, TIME, MessageType, stamp

_FIELDS: Final = {
    "sensor_msgs/Image": "std_msgs/Header header, uint32 height, uint32 width, string encoding, uint8 is_bigendian, "
    "uint32 step, uint8[] data",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force, geometry_msgs/Vector3 torque",
    "geometry_msgs/WrenchStamped": "std_msgs/Header header, geometry_msgs/Wrench wrench",
    "rcl_interfaces/Log": "builtin_interfaces/Time stamp, uint8 level, string name, string msg, string file, "
    "string function, uint32 line",
    "std_msgs/String": "string data",
    "std_msgs/Float64": "float64 data",
    "std_msgs/Int8": "int8 data",
    "sensor_msgs/PointField": "string name, uint32 offset, uint8 datatype, uint32 count",
    "sensor_msgs/PointCloud2": "std_msgs/Header header, uint32 height, uint32 width, sensor_msgs/PointField[] fields, "
    "bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense",
    "diagnostic_msgs/KeyValue": "string key, string value",
    "diagnostic_msgs/DiagnosticStatus": "byte level, string name, string message, string hardware_id, "
    "diagnostic_msgs/KeyValue[] values",
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header, diagnostic_msgs/DiagnosticStatus[] status",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/PointStamped": "std_msgs/Header header, geometry_msgs/Point point",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header, geometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header, string child_frame_id, "
    "geometry_msgs/Transform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}
"""Fields of each type, each after the types in it."""


def _types() -> dict[str, MessageType]:
    types = {"builtin_interfaces/Time": TIME, "std_msgs/Header": STD_HEADER}
    for name, fields in _FIELDS.items():
        lines = fields.split(", ")
        kinds = [line.partition(" ")[0].removesuffix("[]") for line in lines]
        parts = [types[kind] for kind in kinds if kind in types]
        types[name] = MessageType(name.replace("/", "/msg/"), "\n".join(lines), *parts)
    return types


TYPES: Final = _types()
IMAGE: Final = TYPES["sensor_msgs/Image"]
WRENCH_STAMPED: Final = TYPES["geometry_msgs/WrenchStamped"]
LOG: Final = TYPES["rcl_interfaces/Log"]
STRING: Final = TYPES["std_msgs/String"]
FLOAT64: Final = TYPES["std_msgs/Float64"]
INT8: Final = TYPES["std_msgs/Int8"]
POINT_CLOUD: Final = TYPES["sensor_msgs/PointCloud2"]
DIAGNOSTIC_ARRAY: Final = TYPES["diagnostic_msgs/DiagnosticArray"]
POINT_STAMPED: Final = TYPES["geometry_msgs/PointStamped"]
POSE_STAMPED: Final = TYPES["geometry_msgs/PoseStamped"]
POSE_WITH_COVARIANCE_STAMPED: Final = TYPES["geometry_msgs/PoseWithCovarianceStamped"]
TRANSFORM_STAMPED: Final = TYPES["geometry_msgs/TransformStamped"]
TF_MESSAGE: Final = TYPES["tf2_msgs/TFMessage"]


def header(frame: str, unix_ns: int) -> dict[str, Any]:
    """Return the fields of a std_msgs/Header."""
    return {"stamp": stamp(unix_ns), "frame_id": frame}
