"""Types of ROS 2 messages, as ROS's interface definitions have them (Apache-2.0), without their comments."""

from typing import Any, Final

from firmware_bridge.recording.cdr import STD_HEADER, TIME, MessageType, stamp

IMAGE: Final = MessageType(
    "sensor_msgs/msg/Image",
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    "uint8[] data",
    STD_HEADER,
)
VECTOR3: Final = MessageType("geometry_msgs/msg/Vector3", "float64 x\nfloat64 y\nfloat64 z")
_WRENCH: Final = MessageType(
    "geometry_msgs/msg/Wrench", "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque", VECTOR3
)
WRENCH_STAMPED: Final = MessageType(
    "geometry_msgs/msg/WrenchStamped",
    "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    *(STD_HEADER, _WRENCH, VECTOR3),
)
LOG: Final = MessageType(
    "rcl_interfaces/msg/Log",
    "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line",
    TIME,
)
STRING: Final = MessageType("std_msgs/msg/String", "string data")
FLOAT64: Final = MessageType("std_msgs/msg/Float64", "float64 data")
INT8: Final = MessageType("std_msgs/msg/Int8", "int8 data")
_POINT_FIELD: Final = MessageType(
    "sensor_msgs/msg/PointField", "string name\nuint32 offset\nuint8 datatype\nuint32 count"
)
POINT_CLOUD: Final = MessageType(
    "sensor_msgs/msg/PointCloud2",
    "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
    "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
    *(STD_HEADER, _POINT_FIELD),
)
_KEY_VALUE: Final = MessageType("diagnostic_msgs/msg/KeyValue", "string key\nstring value")
_DIAGNOSTIC_STATUS: Final = MessageType(
    "diagnostic_msgs/msg/DiagnosticStatus",
    "byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values",
    _KEY_VALUE,
)
DIAGNOSTIC_ARRAY: Final = MessageType(
    "diagnostic_msgs/msg/DiagnosticArray",
    "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    *(STD_HEADER, _DIAGNOSTIC_STATUS),
)
_POINT: Final = MessageType("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z")
POINT_STAMPED: Final = MessageType(
    "geometry_msgs/msg/PointStamped", "std_msgs/Header header\ngeometry_msgs/Point point", STD_HEADER, _POINT
)
_QUATERNION: Final = MessageType("geometry_msgs/msg/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w")
_POSE: Final = MessageType(
    "geometry_msgs/msg/Pose",
    "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    *(_POINT, _QUATERNION),
)
POSE_STAMPED: Final = MessageType(
    "geometry_msgs/msg/PoseStamped", "std_msgs/Header header\ngeometry_msgs/Pose pose", STD_HEADER, _POSE
)
_POSE_WITH_COVARIANCE: Final = MessageType(
    "geometry_msgs/msg/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance", _POSE
)
POSE_WITH_COVARIANCE_STAMPED: Final = MessageType(
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
    *(STD_HEADER, _POSE_WITH_COVARIANCE),
)
_TRANSFORM: Final = MessageType(
    "geometry_msgs/msg/Transform",
    "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    *(VECTOR3, _QUATERNION),
)
TRANSFORM_STAMPED: Final = MessageType(
    "geometry_msgs/msg/TransformStamped",
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform",
    *(STD_HEADER, _TRANSFORM),
)
TF_MESSAGE: Final = MessageType(
    "tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms", TRANSFORM_STAMPED
)


def header(frame: str, unix_ns: int) -> dict[str, Any]:
    """Return the fields of a std_msgs/Header."""
    return {"stamp": stamp(unix_ns), "frame_id": frame}
