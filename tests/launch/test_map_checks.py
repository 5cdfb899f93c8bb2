"""What is said of a map that contradicts itself, or that will disappoint."""

from typing import Any

import pytest
from msgspec.structs import replace

from cpcbl_launch.simulation.true_map import true_map
from cpcbl_launch.team.checks import problems, warnings
from cpcbl_team.config import (
    Field,
    Landmark,
    LandmarkPosition,
    LocalizerSettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
    Unsurveyed,
    UnsurveyedWall,
    Wall,
)

CORNERS = {
    "sw": Landmark(x_m=0.0, y_m=0.0),
    "se": Landmark(x_m=6.0, y_m=0.0),
    "ne": Landmark(x_m=6.0, y_m=4.0),
}
ROBOT = RobotSettings(source="external", start=Start(x_m=1.0, y_m=1.0))


def team_of(robot: RobotSettings = ROBOT, **objects: Any) -> Team:
    return Team(name="tests", map=Field(**({"landmarks": CORNERS} | objects)), robots={"r1": robot})


@pytest.mark.parametrize(
    ("objects", "begin", "end"),
    [
        ({"unsurveyed": {"sw": Unsurveyed()}}, "map: 'sw' names two things", "rename one of them"),
        ({"unsurveyed": {"r1": Unsurveyed()}}, "map: 'r1' names two things", "rename one of them"),
        (
            {"unsurveyed_walls": {"sw": UnsurveyedWall()}},
            "map: 'sw' names two things",
            "rename one of them",
        ),
        (
            {"landmarks": {"sw": Landmark(x_m=0.0, y_m=0.0, covariance_m2=(1.0, 2.0, 1.0))}},
            "map.landmarks.sw.covariance_m2: [1, 2, 1] is no covariance",
            "write xx, xy, yy in m^2",
        ),
        (
            {
                "landmarks": {
                    "sw": Landmark(x_m=0.0, y_m=0.0, sigma_m=0.1, covariance_m2=(1.0, 0.0, 1.0))
                }
            },
            "map.landmarks.sw.covariance_m2: there is sigma_m, too",
            "remove one of the two",
        ),
        (
            {"walls": {"w": Wall(from_m=(0.0, 0.0), to_m=(0.0, 0.0))}},
            "map.walls.w: has no length",
            "move to_m away from from_m",
        ),
    ],
)
def test_a_map_that_contradicts_itself_is_one_line(
    objects: dict[str, Any], begin: str, end: str
) -> None:
    (line,) = problems(team_of(**objects))
    assert line.startswith(begin)
    assert line.endswith(end)


def test_the_simulated_field_must_know_where_everything_stands() -> None:
    simulated = replace(ROBOT, source="simulated")
    (line,) = problems(team_of(simulated, unsurveyed={"box": Unsurveyed()}))
    assert line.startswith("map.unsurveyed.box.true_m: the simulated field needs it")
    known = team_of(simulated, unsurveyed={"box": Unsurveyed(true_m=(1.0, 2.0))})
    assert list(problems(known)) == []
    assert list(problems(team_of(unsurveyed={"box": Unsurveyed()}))) == []
    hidden = {"w": UnsurveyedWall()}
    (line,) = problems(team_of(simulated, unsurveyed_walls=hidden))
    assert line.startswith("map.unsurveyed_walls.w: the simulated field needs true_from_m")
    assert list(problems(team_of(unsurveyed_walls=hidden))) == []
    there = {"w": UnsurveyedWall(true_from_m=(0.0, 0.0), true_to_m=(6.0, 0.0))}
    team = team_of(simulated, unsurveyed_walls=there)
    assert list(problems(team)) == []
    assert true_map(team, 1).walls == {"w": Wall(from_m=(0.0, 0.0), to_m=(6.0, 0.0))}


def test_what_one_robot_knows_is_about_unsurveyed_landmarks() -> None:
    known = {"bax": LandmarkPosition(x_m=1.0, y_m=2.0)}
    unsurveyed = {"box": Unsurveyed()}
    (line,) = problems(team_of(replace(ROBOT, known_landmarks=known), unsurveyed=unsurveyed))
    assert line == "robots.r1.known_landmarks.bax: map.unsurveyed has no 'bax'; write box"
    odd = {"box": LandmarkPosition(x_m=1.0, y_m=2.0, covariance_m2=(0.01, 0.02, 0.01))}
    (line,) = problems(team_of(replace(ROBOT, known_landmarks=odd), unsurveyed=unsurveyed))
    assert line.startswith("robots.r1.known_landmarks.box.covariance_m2: [0.01, 0.02, 0.01]")


def test_the_map_of_a_robot_holds_what_it_alone_knows() -> None:
    known = {"box": LandmarkPosition(x_m=1.0, y_m=2.0, sigma_m=0.1)}
    unsurveyed = {"box": Unsurveyed(gives="bearing"), "cone": Unsurveyed()}
    team = team_of(replace(ROBOT, known_landmarks=known), unsurveyed=unsurveyed)
    own = team.map_of("r1")
    box = Landmark(x_m=1.0, y_m=2.0, sigma_m=0.1, gives="bearing")
    assert own.landmarks == CORNERS | {"box": box}
    assert own.unsurveyed == {"cone": Unsurveyed()}
    assert own.names == team.map.names


def test_only_joint_finds_landmarks() -> None:
    oval = replace(ROBOT, localizer=LocalizerSettings(variant="oval"))
    (line,) = warnings(team_of(oval, unsurveyed={"box": Unsurveyed()}))
    assert line.startswith("robots.r1.localizer.variant: oval does not find landmarks")
    known = replace(oval, known_landmarks={"box": LandmarkPosition(x_m=1.0, y_m=2.0)})
    assert list(warnings(team_of(known, unsurveyed={"box": Unsurveyed()}))) == []
    assert list(warnings(team_of(unsurveyed={"box": Unsurveyed()}))) == []


def test_a_map_from_nothing_needs_a_start() -> None:
    nothing: dict[str, Any] = {"landmarks": {}, "unsurveyed": {"box": Unsurveyed()}}
    assert list(warnings(team_of(**nothing))) == []
    (line,) = warnings(team_of(replace(ROBOT, start=None), **nothing))
    assert line.startswith("map.unsurveyed: no robot knows its start")
    unknown = replace(ROBOT, start=Start(x_m=1.0, y_m=1.0, known=False))
    assert list(warnings(team_of(unknown, **nothing))) == [line]
    assert list(warnings(team_of(unknown, **nothing, frame="agreed"))) == []


def test_a_frame_is_agreed_where_there_is_no_map_and_robots_have_covariances() -> None:
    (line,) = problems(team_of(frame="agreed"))
    assert line.startswith("map.frame: agreed is for a team without a map")
    nothing: dict[str, Any] = {"landmarks": {}, "frame": "agreed"}
    assert list(problems(team_of(**nothing))) == []
    weighted = replace(ROBOT, localizer=LocalizerSettings(variant="weighted"))
    (line,) = problems(team_of(weighted, **nothing))
    assert line.startswith("robots.r1.localizer.variant: weighted knows no covariance")


def test_what_links_two_frames_must_be_seen() -> None:
    nothing: dict[str, Any] = {"landmarks": {}, "frame": "agreed"}
    unseeing = replace(ROBOT, sensor=SensorSettings(sees_robots=False))
    assert any(line.startswith("map.frame:") for line in warnings(team_of(unseeing, **nothing)))
    for team in (
        team_of(**nothing),
        team_of(unseeing, **nothing, unsurveyed={"box": Unsurveyed()}),
    ):
        assert not any(line.startswith("map.frame:") for line in warnings(team))


def test_a_sigma_in_millimetres_is_said() -> None:
    marks = CORNERS | {"ne": replace(CORNERS["ne"], sigma_m=20.0)}
    lines = [line for line in warnings(team_of(landmarks=marks)) if "ne.sigma_m" in line]
    assert any(line.endswith("write 0.02") for line in lines)
