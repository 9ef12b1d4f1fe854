"""ROS 2 messages of poses and transforms, as ROS's interface definitions have them (Apache-2.0), without comments."""

from typing import Final

from edge.sinks.ros2.cdr_messages import VECTOR3
from firmware_bridge.recording.cdr import STD_HEADER, MessageType

_POINT: Final = MessageType("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z")
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
