"""Damaged messages of ROS 2 through all of the bridge's inputs: each becomes an input, or is
counted under a reason; none is an error, and the bridge goes on."""

import random
from collections import Counter

import pytest
from fuzz.test_ros2_payloads import damaged
from support.buses import Subscription
from support.ros2 import (
    MS,
    T0,
    camera_info,
    detection,
    detections,
    lab,
    message,
    message_types,
    odometry,
    pose_stamped,
    static,
)

from cpcbl_launch.run.ros2.planar import header_fields
from cpcbl_launch.run.ros2.refused import RefusalLog
from cpcbl_launch.run.ros2.robot_inputs import InputTopic, RobotInputs
from cpcbl_launch.run.ros2.stamps import UnixStamps
from cpcbl_team.geometry import Pose2
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Refusal, refusal
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.messages import Message, PayloadRefusal

STAMPS = UnixStamps()
START = "start = {{ x_m = {}.0"
TOPICS = 'ros2 = { detections_3d = "found", ranges = "ranges", navsat = "gps", position = "place" }'
DATUM = "[ros2]\ndatum = { latitude_deg = 52.0, longitude_deg = 13.0 }"
CAMERA = 'sensing = "camera"\nros2 = { image = "image" }'
TEAM = lab(
    ("[ros2]", DATUM),
    *((START.format(n), f"{more}\n{START.format(n)}") for n, more in enumerate((TOPICS, CAMERA))),
)


def plausible(row: InputTopic, at_ns: int) -> Message:
    """A message that the bridge takes."""
    header = header_fields(at_ns, "base_link")
    square = [(300.0, 200.0), (340.0, 200.0), (340.0, 240.0), (300.0, 240.0)]
    match row.type_name:
        case types.ODOMETRY:
            return odometry(at_ns, Pose2((at_ns - T0) * 1e-10, 0.0, 0.1), (0.1, 0.0))
        case types.APRIL_TAGS:
            return detections(at_ns, detection(7, square), detection(0, square))
        case types.CAMERA_INFO:
            return camera_info(header=header_fields(at_ns, "camera"))
        case types.DETECTIONS:
            best = {"hypothesis": {"class_id": "door", "score": 1.0}}
            best["pose"] = {"pose": {"position": {"x": 2.0, "y": 0.5}}}
            return message(row.type_name, header=header, detections=[{"results": [best]}])
        case types.RANGE:
            fields = {"range": 2.0, "min_range": 0.1, "max_range": 9.0}
            return message(row.type_name, header=header_fields(at_ns, "door"), **fields)
        case types.POSE:
            return pose_stamped(at_ns, Pose2(1.0, 2.0, 0.5), 0.5)
        case types.NAV_SAT_FIX:
            fix = {"latitude": 52.0001, "longitude": 13.0001, "position_covariance_type": 2}
            return message(row.type_name, header=header, position_covariance=[1.0] * 9, **fix)
        case types.TRANSFORMS:
            return message(row.type_name, transforms=[static("base_link", "camera", (0, 0, 0.3))])
    size = {"height": 4, "width": 6, "step": 18, "encoding": "bgr8", "data": [9] * 72}
    return message(types.IMAGE, header=header, **size)


@pytest.mark.parametrize("count", [300, pytest.param(100_000, id="all", marks=pytest.mark.long)])
def test_any_message_is_an_input_or_is_counted(count: int) -> None:
    rng, hub, refusals, now_ns = random.Random(count), MemoryHub(), RefusalLog(), T0
    ear, own = Subscription(hub.session(), "in/**"), message_types()
    rows = [
        (inputs, row)
        for name in TEAM.robots
        for inputs in [RobotInputs(name, TEAM, hub.session(), STAMPS, lambda: now_ns, refusals)]
        for row in inputs.topics()
    ]
    came: Counter[str] = Counter()
    for number in range(count):
        inputs, row = rows[number % len(rows)]
        now_ns = T0 + number * 2 * MS
        payload = own.encode(plausible(row, now_ns))
        if rng.random() < 0.9:
            payload = damaged(payload, rng)
        decoded = own.decode(row.type_name, payload)
        if not isinstance(decoded, PayloadRefusal):
            inputs.on_message(row, decoded)
            came[row.type_name] += 1
    assert came.keys() == {row.type_name for _, row in rows}
    reasons = {reason for _, reason in refusals.counts}
    assert "unreadable" not in reasons, refusals.lines()
    assert len(reasons) > 3
    kinds = {type(given).__name__ for given in ear.messages}
    assert kinds == {"Odometry", "Sightings", "Position", "InitialPose", "Frame"}
    useless = [m for m in ear.messages if isinstance(m, Refusal) or refusal(m, now_ns)]
    assert len(useless) <= sum(n for (_, why), n in refusals.counts.items() if why == "unsupported")
