"""Definitions of the ROS messages that are written, and of those whose definition an old bag may lack (ROS 2, vision_msgs 4)."""

from __future__ import annotations

_STAMPED = "std_msgs/Header header\n"
PARTS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/msg/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/msg/PoseStamped": _STAMPED + "geometry_msgs/Pose pose\n",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/msg/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/msg/TransformStamped": _STAMPED + "string child_frame_id\ngeometry_msgs/Transform transform\n",
    "sensor_msgs/msg/CompressedImage": _STAMPED + "string format\nuint8[] data\n",
    "visualization_msgs/msg/UVCoordinate": "float32 u\nfloat32 v\n",
    "visualization_msgs/msg/MeshFile": "string filename\nuint8[] data\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection2D": (
        _STAMPED + "vision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3D": (
        _STAMPED + "vision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "visualization_msgs/msg/Marker": (
        "int32 CUBE=1\nint32 SPHERE=2\nint32 TEXT_VIEW_FACING=9\nint32 ADD=0\n"
        + _STAMPED
        + "string ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\n"
        "std_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n"
        "std_msgs/ColorRGBA[] colors\nstring texture_resource\nsensor_msgs/CompressedImage texture\n"
        "visualization_msgs/UVCoordinate[] uv_coordinates\nstring text\nstring mesh_resource\n"
        "visualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n"
    ),
}
"""Types that others are made of."""
WRITTEN = {
    "nav_msgs/msg/Path": _STAMPED + "geometry_msgs/PoseStamped[] poses\n",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "visualization_msgs/msg/MarkerArray": "visualization_msgs/Marker[] markers\n",
    "vision_msgs/msg/Detection3DArray": _STAMPED + "vision_msgs/Detection3D[] detections\n",
}
"""Types of the topics that are written."""


def with_parts(text: str) -> str:
    """A definition followed by those of every type (all of `PARTS`), as bags hold them."""
    line = "=" * 80
    return "\n".join([text, *(f"{line}\nMSG: {name.replace('/msg/', '/')}\n{part}" for name, part in PARTS.items())])


VISION = {
    "vision_msgs/msg/Detection3DArray": with_parts(WRITTEN["vision_msgs/msg/Detection3DArray"]),
    "vision_msgs/msg/Detection2DArray": with_parts(_STAMPED + "vision_msgs/Detection2D[] detections\n"),
}
"""Whole definitions of arrays of detections."""
