"""Checks of what a team file says of ROS 2: topics, tags, routers."""

from collections.abc import Iterator

from cpcbl_launch.team.endpoints import endpoint_problem
from cpcbl_team.config import MARKERS, Ros2Settings, Team
from cpcbl_team.errors import nearest_name
from cpcbl_transport.ros2.names import RosNameError, topic_name

INPUTS = (
    *("odometry", "detections", "camera_info", "detections_3d", "ranges", "image"),
    *("compressed_image", "navsat", "position", "initial_pose"),
)
OUTPUTS = ("pose", "pose_odometry")
SHARED = ("tf", "tf_static")  # by all robots, if they have one tree
NEED_CAMERA = ("image", "compressed_image")


def ros2_problems(team: Team) -> Iterator[str]:
    """The contradictions of the tables of ROS 2, each as `key: problem; fix`."""
    ros2 = team.ros2
    if ros2 is None:
        return
    yield from _router_problems(team, ros2)
    yield from _tag_problems(team, ros2)
    yield from _topic_problems(team, ros2)
    for name, robot in team.robots.items():
        key = f"robots.{name}.ros2"
        if robot.ros2.navsat and ros2.datum is None:
            fix = "add ros2.datum with latitude_deg and longitude_deg"
            yield f"{key}.navsat: where is the field on the earth? {fix}"
        if robot.ros2.map_frame and not robot.ros2.tf_static:
            fix = "name its topic in tf_static, which says where it is"
            yield f"{key}.map_frame: nothing connects it with {ros2.field_frame!r}; {fix}"
        if robot.ros2.odometry_frame in (robot.ros2.map_frame, ros2.field_frame):
            yield f"{key}.odometry_frame: is the field's frame too; give it its own"
        for image in NEED_CAMERA:
            if getattr(robot.ros2, image) and robot.sensing != "camera":
                fix = 'set sensing = "camera", so that this software looks for objects in them'
                yield f"{key}.{image}: nobody looks at images of {name}; {fix}"
        if robot.ros2.image and robot.ros2.compressed_image:
            yield f"{key}.image: compressed_image has the same images; remove one of them"


def _router_problems(team: Team, ros2: Ros2Settings) -> Iterator[str]:
    for endpoint in ros2.connect:
        if reason := endpoint_problem(endpoint):
            yield f"ros2.connect: {endpoint!r}: {reason}"
        elif endpoint.startswith("tls/") and not ros2.keys:
            fix = "name the folder of ca.crt, certificate.crt and private.key in ros2.keys"
            yield f"ros2.connect: {endpoint!r}: needs certificates; {fix}"
        elif ros2.keys and not endpoint.startswith("tls/"):
            where = endpoint.partition("/")[2]
            yield f"ros2.connect: {endpoint!r}: with ros2.keys write it as tls/{where}"
    if ros2.keys and not ros2.connect:
        yield "ros2.keys: are for the endpoints of ros2.connect; name them there"
    if team.transport.secured and not ros2.connect:
        fix = "name the router of the ROS 2 robots, such as tcp/127.0.0.1:7448"
        yield f"ros2.connect: the router of a secured team admits no ROS 2; {fix}"


def _tag_problems(team: Team, ros2: Ros2Settings) -> Iterator[str]:
    family = team.vision.family
    if ros2.tags and not family.startswith("apriltag_"):
        yield f'vision.family: {family} has no AprilTags; write family = "apriltag_36h11"'
        return
    carried = {n: f"robots.{r}" for r, robot in team.robots.items() for n in robot.markers.values()}
    used: dict[int, str] = {}
    for name, tag in ros2.tags.items():
        key = f"ros2.tags.{name}"
        if name not in team.map.all_landmarks:
            near = nearest_name(name, team.map.all_landmarks)
            hint = f"did you mean {near!r}?" if near else "add it to map.landmarks"
            yield f"{key}: no landmark {name!r}; {hint}"
        if tag.id >= MARKERS[family]:
            yield f"{key}.id: {family} has no tag {tag.id}; use 0 to {MARKERS[family] - 1}"
        elif other := used.get(tag.id) or carried.get(tag.id):
            yield f"{key}.id: {other} has the tag {tag.id} too; give each its own"
        used.setdefault(tag.id, key)


def _topic_problems(team: Team, ros2: Ros2Settings) -> Iterator[str]:
    """Topics have names that ROS 2 allows, and no two robots have one in common."""
    for key in ("diagnostics", "markers"):
        yield from _name_problem(f"ros2.{key}", getattr(ros2, key))
    known: dict[str, str] = {}
    for name, robot in team.robots.items():
        driven = INPUTS if robot.source == "external" else ()
        for key in (*driven, *OUTPUTS, *SHARED):
            topic = getattr(robot.ros2, key)
            if not topic:
                continue
            full, path = ros2.topic(name, topic), f"robots.{name}.ros2.{key}"
            faults = list(_name_problem(path, full))
            yield from faults
            if faults or key in SHARED:
                continue
            if other := known.get(full):
                fix = "put {robot} into ros2.namespace, or name it otherwise"
                yield f"{path}: {other} has the topic {full!r} too; {fix}"
            known.setdefault(full, path)


def _name_problem(key: str, topic: str) -> Iterator[str]:
    if not topic:
        return
    try:
        topic_name(topic)
    except RosNameError as error:
        yield f"{key}: {error}"
