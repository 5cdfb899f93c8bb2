"""The bridge between a team and robots that run ROS 2: where they are, topics, frames."""

from typing import Annotated, Literal

import msgspec

from cpcbl_team.config.table import NotNegative, Positive, Table

Distribution = Literal["humble", "jazzy", "kilted", "lyrical", "rolling"]
Layout = Literal["rmw_zenoh", "ros2dds"]
DetectionFrame = Literal["by_name", "robot", "camera"]


class Tag(Table, frozen=True, kw_only=True):
    """An AprilTag at a landmark: upright, its centre at the landmark's position."""

    id: Annotated[int, msgspec.Meta(ge=0)]
    side_m: Positive | None = None
    """The side of its black square; None: that of the robots' markers, `vision.marker_m`."""
    mounted_m: Positive | None = None
    """The height of its centre above the floor; None: `vision.marker_mounted_m`."""


class Datum(Table, frozen=True, kw_only=True):
    """Where the field's origin is on the earth (WGS 84), for sensor_msgs/NavSatFix."""

    latitude_deg: Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]
    x_axis_deg: float = 0.0
    """The direction of the field's x axis: counter-clockwise from east."""


class Ros2Settings(Table, frozen=True, kw_only=True):
    """The bridge to ROS 2 (`cpcbl-team bridge ros2`). With this table `up` starts it, and `robot`
    starts one for its robot."""

    connect: tuple[str, ...] = ()
    """The Zenoh router of the ROS 2 robots, such as rmw_zenohd; empty: the team's own router."""
    keys: str = ""
    """The folder with ca.crt, certificate.crt and private.key for tls/ endpoints of `connect`,
    relative to the team file; empty: without TLS."""
    distribution: Distribution = "jazzy"
    """Whose message definitions and type hashes are used."""
    layout: Layout = "rmw_zenoh"
    """ros2dds: the robots use DDS, behind a zenoh-bridge-ros2dds."""
    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
    """ROS_DOMAIN_ID of the robots."""
    namespace: str = "{robot}"
    """The namespace of a robot's topics; `{robot}` is its name. Empty: none."""
    field_frame: Annotated[str, msgspec.Meta(min_length=1)] = "map"
    """What ROS 2 calls the field's frame."""
    sim_time: bool = False
    """Stamps are those of a simulation (use_sim_time), which are mapped to this machine's time."""
    transform_tolerance_s: NotNegative = 0.5
    """The transform field_frame -> odom_frame is stamped this much ahead, as AMCL's is, so that it
    can be used until the next one comes."""
    diagnostics: str = "/diagnostics"
    """The topic of diagnostic_msgs/DiagnosticArray; empty: none."""
    markers: str = "/cpcbl/markers"
    """The topic of visualization_msgs/MarkerArray; empty: none."""
    markers_rate_hz: Positive = 2.0
    tags: dict[str, Tag] = msgspec.field(default_factory=dict)
    """The AprilTags at landmarks, by the landmark's name. Those on robots are `markers`."""
    datum: Datum | None = None

    def topic(self, robot: str, topic: str) -> str:
        """A topic of a robot without its first slash: in its namespace, unless it is absolute."""
        if topic.startswith("/"):
            return topic.lstrip("/")
        space = self.namespace.replace("{robot}", robot).strip("/")
        return f"{space}/{topic}" if space else topic


class Ros2RobotSettings(Table, frozen=True, kw_only=True):
    """The topics and frames of one robot. A topic that begins with a slash is absolute, any other
    one is in the robot's namespace; an empty one is not used."""

    odometry: str = "odom"
    """nav_msgs/Odometry."""
    detections: str = "detections"
    """apriltag_msgs/AprilTagDetectionArray; needs `camera_info`."""
    camera_info: str = "camera_info"
    """sensor_msgs/CameraInfo of the camera that `detections` comes from."""
    rectified: bool = True
    """Detections are of a rectified image (apriltag_ros: image_rect), so the projection matrix P of
    CameraInfo counts. False: of the raw image, so K and the distortion D count."""
    detections_3d: str = ""
    """vision_msgs/Detection3DArray; the class of each detection is the name of an object."""
    detections_3d_frame: DetectionFrame = "by_name"
    """The axes of Detection3DArray: the robot's, or the camera's optical ones, whose mounting is
    the table `camera`. by_name: optical if the name of the frame has `optical` in it."""
    ranges: str = ""
    """sensor_msgs/Range; its frame_id is the name of an object."""
    image: str = ""
    """sensor_msgs/Image, for a robot with sensing = "camera"."""
    compressed_image: str = ""
    """sensor_msgs/CompressedImage, for a robot with sensing = "camera"."""
    navsat: str = ""
    """sensor_msgs/NavSatFix as a position; needs `ros2.datum`."""
    position: str = ""
    """geometry_msgs/PoseWithCovarianceStamped as a position in the field's frame."""
    initial_pose: str = "initialpose"
    """geometry_msgs/PoseWithCovarianceStamped in the field's frame that replaces the robot's pose:
    the button "2D Pose Estimate" of RViz."""
    tf_static: str = "tf_static"
    """tf2_msgs/TFMessage: where the frames of sensors are on the robot."""
    odometry_frame: str = "odom"
    """The frame of odometry: what its messages must name, with or without a prefix."""
    base_frame: str = ""
    """The robot's frame in odometry; empty: whatever it names first."""
    fastest_m_s: Positive = 5.0
    """Poses of odometry that imply a higher speed are a jump or a reset, and move nothing."""
    fastest_turn_rad_s: Positive = 10.0
    map_frame: str = ""
    """The robot's own frame of the field, such as r1/map, for a tree of its own; empty:
    `field_frame`. Poses are in it, and a static transform says that it is the field's frame."""
    pose: str = "amcl_pose"
    """geometry_msgs/PoseWithCovarianceStamped, where AMCL has its own."""
    pose_odometry: str = ""
    """nav_msgs/Odometry of the pose in the field's frame."""
    tf: str = "tf"
    """tf2_msgs/TFMessage with field_frame -> odom_frame; Nav2 remaps /tf into the namespace of a
    robot. Write /tf where all robots share one tree."""
    republish_odometry_tf: bool = False
    """Also publish odom_frame -> base_frame, for a driver that does not."""
