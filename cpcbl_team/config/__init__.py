"""The settings of a robot, a field and a team: the tables of a team file.

Every setting is typed and has a default; its unit is in its name. The reader of a
team file refuses unknown keys. docs/team_file.md describes all of them.
"""

from cpcbl_team.config.camera import COLOURS as COLOURS
from cpcbl_team.config.camera import LIKE_MIRRORED as LIKE_MIRRORED
from cpcbl_team.config.camera import MARKERS as MARKERS
from cpcbl_team.config.camera import CameraSettings as CameraSettings
from cpcbl_team.config.camera import Colour as Colour
from cpcbl_team.config.camera import Cylinder as Cylinder
from cpcbl_team.config.camera import MarkerFamily as MarkerFamily
from cpcbl_team.config.camera import Side as Side
from cpcbl_team.config.camera import VisionSettings as VisionSettings
from cpcbl_team.config.collaboration import BudgetSettings as BudgetSettings
from cpcbl_team.config.collaboration import CollaborationSettings as CollaborationSettings
from cpcbl_team.config.collaboration import Direction as Direction
from cpcbl_team.config.collaboration import Fusion as Fusion
from cpcbl_team.config.collaboration import TrustSettings as TrustSettings
from cpcbl_team.config.field import Bands as Bands
from cpcbl_team.config.field import Field as Field
from cpcbl_team.config.field import Gives as Gives
from cpcbl_team.config.field import Landmark as Landmark
from cpcbl_team.config.field import LandmarkPosition as LandmarkPosition
from cpcbl_team.config.field import Light as Light
from cpcbl_team.config.field import SimulationEvent as SimulationEvent
from cpcbl_team.config.field import SimulationSettings as SimulationSettings
from cpcbl_team.config.field import Unsurveyed as Unsurveyed
from cpcbl_team.config.field import UnsurveyedWall as UnsurveyedWall
from cpcbl_team.config.field import Wall as Wall
from cpcbl_team.config.localizer import LocalizerSettings as LocalizerSettings
from cpcbl_team.config.localizer import Variant as Variant
from cpcbl_team.config.localizer import Weights as Weights
from cpcbl_team.config.recording import RecordingSettings as RecordingSettings
from cpcbl_team.config.ros2 import Datum as Datum
from cpcbl_team.config.ros2 import Distribution as Distribution
from cpcbl_team.config.ros2 import Ros2RobotSettings as Ros2RobotSettings
from cpcbl_team.config.ros2 import Ros2Settings as Ros2Settings
from cpcbl_team.config.ros2 import Tag as Tag
from cpcbl_team.config.sensors import OdometryNoise as OdometryNoise
from cpcbl_team.config.sensors import OdometrySettings as OdometrySettings
from cpcbl_team.config.sensors import PositionSensor as PositionSensor
from cpcbl_team.config.sensors import SensorSettings as SensorSettings
from cpcbl_team.config.team import GatewaySettings as GatewaySettings
from cpcbl_team.config.team import GuardSettings as GuardSettings
from cpcbl_team.config.team import GuestSettings as GuestSettings
from cpcbl_team.config.team import LocalizationSettings as LocalizationSettings
from cpcbl_team.config.team import MatchSettings as MatchSettings
from cpcbl_team.config.team import RobotSettings as RobotSettings
from cpcbl_team.config.team import Source as Source
from cpcbl_team.config.team import Start as Start
from cpcbl_team.config.team import Team as Team
from cpcbl_team.config.team import TransportSettings as TransportSettings
