"""Definitions of messages: those that ROS 2 itself does not ship, and empty messages of any type.

Of the definitions only names and types of fields count: a type hash knows no comments. Humble and
all later distributions have the same vision_msgs (4.x) and apriltag_msgs (2.x).
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

QUATERNION = "geometry_msgs/msg/Quaternion"

APRILTAG_AND_VISION = {
    "apriltag_msgs/msg/Point": """
float64 x
float64 y
""",
    "apriltag_msgs/msg/AprilTagDetection": """
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
Point centre
Point[4] corners
float64[9] homography
""",
    "apriltag_msgs/msg/AprilTagDetectionArray": """
std_msgs/Header header
AprilTagDetection[] detections
""",
    "vision_msgs/msg/ObjectHypothesis": """
string class_id
float64 score
""",
    "vision_msgs/msg/ObjectHypothesisWithPose": """
ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose
""",
    "vision_msgs/msg/BoundingBox3D": """
geometry_msgs/Pose center
geometry_msgs/Vector3 size
""",
    "vision_msgs/msg/Detection3D": """
std_msgs/Header header
ObjectHypothesisWithPose[] results
BoundingBox3D bbox
string id
""",
    "vision_msgs/msg/Detection3DArray": """
std_msgs/Header header
Detection3D[] detections
""",
}


def new_message(store: "Typestore", name: str) -> Any:
    """A message whose numbers are zero, and whose texts and sequences are empty; only the scalar
    part of a quaternion is one, as in ROS 2. Raises KeyError for a type that is not known."""
    fields = {field: _empty(store, description) for field, description in store.fielddefs[name][1]}
    if name == QUATERNION:
        fields["w"] = 1.0
    return store.types[name](**fields)


def _empty(store: "Typestore", description: Any) -> Any:
    """The empty value of a field, by rosbags' description of it."""
    import numpy as np
    from rosbags.interfaces import Nodetype

    kind, of = description
    if kind == Nodetype.NAME:
        return new_message(store, of)
    if kind == Nodetype.BASE:
        return _EMPTY.get(of[0], 0)
    (inner_kind, inner), count = of
    length = count if kind == Nodetype.ARRAY else 0
    if inner_kind == Nodetype.BASE and inner[0] != "string":
        return np.zeros(length, dtype=_NUMPY_NAMES.get(inner[0], inner[0]))
    return [_empty(store, (inner_kind, inner)) for _ in range(length)]


_EMPTY: dict[str, Any] = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}
_NUMPY_NAMES = {"byte": "uint8", "char": "uint8", "bool": "bool_"}
