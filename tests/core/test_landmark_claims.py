"""A place is believed no better than its robot can know it by the team file."""

from typing import Any

from msgspec.structs import replace

from cpcbl_team.config import (
    Field,
    LandmarkPosition,
    PositionSensor,
    RobotSettings,
    Start,
    Team,
    Unsurveyed,
)
from cpcbl_team.inputs import LandmarkBelief
from cpcbl_team.landmark_claims import LandmarkClaims

MARKS = Field(unsurveyed={"oak": Unsurveyed(), "elm": Unsurveyed()})
AT_5_CM = RobotSettings(start=Start(x_m=0.0, y_m=0.0, sigma_m=0.05))
AT_20_CM = RobotSettings(start=Start(x_m=0.0, y_m=0.0, sigma_m=0.2))
GUIDE = replace(AT_20_CM, known_landmarks={"oak": LandmarkPosition(x_m=1.0, y_m=2.0)})


def variance(robot: str, landmark: str, stated: float = 1e-6, **robots: RobotSettings) -> float:
    """Of the place that `robot` tells and states so certain, as it is believed."""
    team = Team(name="some", map=MARKS, robots=robots)
    told = LandmarkBelief(robot, landmark, 1, 1.0, 2.0, (stated, 0.0, 2.0 * stated))
    believed = LandmarkClaims(team, 0.02).believed(told)
    assert replace(believed, covariance=told.covariance) == told
    xx, xy, yy = believed.covariance
    assert xx <= yy
    assert xy == 0.0
    return xx


def test_where_nobody_knows_the_field_no_place_is_better_than_the_best_start() -> None:
    robots: dict[str, Any] = {"a": AT_5_CM, "b": AT_20_CM}
    assert variance("b", "oak", **robots) == 0.05**2
    assert variance("b", "oak", stated=0.01, **robots) == 0.01
    hidden = RobotSettings(start=Start(x_m=0.0, y_m=0.0, sigma_m=0.05, known=False))
    assert variance("b", "oak", a=hidden, b=AT_20_CM) == 0.2**2


def test_who_is_given_a_place_knows_it_better_than_all_others() -> None:
    """Who states a millimetre would be asked alone, and the guide not at all."""
    robots: dict[str, Any] = {"a": GUIDE, "b": AT_5_CM}
    assert variance("a", "oak", **robots) == 1e-6
    assert variance("b", "oak", **robots) == 0.02**2
    assert variance("b", "elm", **robots) == 1e-6  # it may have found it from the guide's places


def test_a_robot_that_finds_itself_may_know_places_as_well_as_it_says() -> None:
    sensing = replace(AT_5_CM, position_sensor=PositionSensor(sigma_m=0.01))
    assert variance("a", "oak", a=sensing, b=AT_20_CM) == 1e-6
