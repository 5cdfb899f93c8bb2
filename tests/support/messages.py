"""One valid message of every type."""

import msgspec

from cpcbl_team.config.sensors import PositionSensorModel
from cpcbl_team.config.team import StartModel
from cpcbl_team.inputs import (
    Belief,
    Fix,
    InitialPose,
    LandmarkBelief,
    Odometry,
    Position,
    Sighting,
    Sightings,
)
from cpcbl_transport.messages import (
    AnnotatedFrame,
    Drive,
    Flow,
    Frame,
    InputHealth,
    Join,
    LandmarkEstimate,
    Pose,
    SimulatedRobotModel,
    Spending,
    Status,
    Track,
    Trust,
    Truth,
    Truths,
    UnclearObject,
)
from support.buses import SECOND

NOW = 5 * SECOND
COVARIANCE = (0.04, 0.01, 0.09, 0.0, 0.0, 0.01)

ODOMETRY = Odometry(NOW - SECOND, NOW, 0.5, 0.1)
SIGHTINGS = Sightings(NOW, (Sighting("oak", 2.0, 0.1), Sighting("elm", None, -0.5, None, 0.02)))
POSITION = Position(NOW, 1.0, 2.0, (0.0004, 0.0, 0.0009))
INITIAL_POSE = InitialPose(NOW, 1.0, 2.0, 0.5, COVARIANCE)
JPEG = bytes(range(256))
FRAME = Frame(NOW, JPEG)
MATE_SEEN = Sighting("r2", 2.0, 0.1, 0.02, 0.003, -1.5, 0.05)
LOOK = AnnotatedFrame("r1", NOW, JPEG, (MATE_SEEN,), (UnclearObject("ambiguous", ("r2", "r3")),))
LEARNED = (0.98, 0.96, -0.01)
STATUS = Status("r1", "a", NOW, 0.1, 0.02, 3, "", {"odometry": 7}, 1, 20, 2, 40, LEARNED)
SENT = (Flow("fix", "r2", 1, 41, 2, 3, 0, NOW), Flow("belief", "", 0, 0, 0, 0, 4))
SPENDING = (Spending("bytes", 10.0, 500.0, 400.0),)
TRUST = (Trust("r2", "biased", NOW, 2, False, -0.4),)
STATUS = msgspec.structs.replace(STATUS, sent=SENT, heard=SENT[:1], spending=SPENDING, trust=TRUST)
OLDER_STATUS = STATUS  # as the first releases sent it
INPUTS = (InputHealth("odometry", 9.5, NOW, 7, {"too_late": 2}, 0.02),)
STATUS = msgspec.structs.replace(STATUS, inputs=INPUTS, problems=("camera lost",))
CONFIRMED_STATUS = STATUS  # as robots sent it that did not know of unconfirmed poses
SURVEYED_STATUS = msgspec.structs.replace(STATUS, unconfirmed="it stood")
"""As robots sent it that found no landmarks themselves."""
PLACES = (LandmarkEstimate("box", 2.0, 0.5, (0.01, 0.0, 0.02)),)
FIELD_STATUS = msgspec.structs.replace(SURVEYED_STATUS, places=PLACES)
"""As robots sent it that knew no frame but that of the field."""
OWN_FRAME = "r1.00000k3"
STATUS = msgspec.structs.replace(FIELD_STATUS, frame=OWN_FRAME)
FIELD_TRACK = Track("r1", NOW, 1.0, 2.0, 0.5, COVARIANCE, 3)
TRACK = msgspec.structs.replace(FIELD_TRACK, frame=OWN_FRAME)
ROWS = ((0.04, 0.01, 0.0), (0.01, 0.09, 0.0), (0.0, 0.0, 0.01))
CONFIRMED_POSE = Pose("r1", NOW, 1.0, 2.0, 0.5, ROWS, "kidnapped")
FIELD_POSE = msgspec.structs.replace(CONFIRMED_POSE, unconfirmed="it stood")
POSE = msgspec.structs.replace(FIELD_POSE, frame=OWN_FRAME)
DRIVE = Drive("r1", NOW, 0.5, 0.1)
MODEL = SimulatedRobotModel(StartModel(x_m=1.0, y_m=2.0), position_sensor=PositionSensorModel())
JOIN = Join("tripod", "a", NOW, MODEL)
TRUTHS = Truths(NOW, (Truth("r1", 1.0, 2.0, 0.5, 1), Truth("r2", 3.0, 4.0, -0.5)))
VALID = (
    *(ODOMETRY, SIGHTINGS, POSITION, INITIAL_POSE, FRAME),
    *(LOOK, STATUS, TRACK, POSE, DRIVE, JOIN, TRUTHS),
)
LANDMARK = LandmarkBelief("r1", "oak", NOW, 1.0, 2.0, (0.04, 0.01, 0.09))
BELIEF = Belief("r1", NOW, 1.0, 2.0, 0.5, COVARIANCE, 0.25, -0.1)
FIX = Fix("r2", "r1", NOW, 1.5, -2.5, (0.04, 0.01, 0.09), (0.01, 0.0, 0.02))
HEADED_FIX = msgspec.structs.replace(
    FIX, heading_rad=0.5, heading_sensor_variance=0.01, heading_observer_variance=0.002
)
