"""Definitions of messages that ROS 2 itself does not ship: vision_msgs (4.x), apriltag_msgs (2.x).

Only names and types of fields count: a type hash knows no comments. Humble and all later
distributions have the same ones.
"""

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
