"""The bridge as a service of a compose file."""

from typing import Any

import pytest
import yaml
from msgspec.structs import replace
from support.buses import robot_at, team_of

from cpcbl_launch.run.containers.compose import Deployment, compose_text
from cpcbl_team.config import Ros2Settings, Team
from cpcbl_team.errors import InputError


def services_of(team: Team) -> dict[str, Any]:
    how = Deployment("demo", "cpcbl-team:1", context="..")
    return dict(yaml.safe_load(compose_text(team, how))["services"])


def test_a_team_with_ros_2_has_a_bridge_beside_its_robots() -> None:
    team = replace(team_of(a=robot_at(), b=robot_at()), ros2=Ros2Settings())
    found = services_of(team)
    assert list(found) == ["router", "robot-a", "robot-b", "bridge"]
    to_router = ["--connect", "tcp/router:7447"]
    assert found["bridge"]["command"] == ["bridge", "ros2", "demo", *to_router, "--robots", "a,b"]
    assert found["router"]["build"]["args"]["EXTRAS"] == "ros2"
    tagged = replace(team, robots={**team.robots, "c": replace(robot_at(), markers={"front": 0})})
    built = services_of(tagged)["router"]["build"]
    assert built["args"]["EXTRAS"] == "camera ros2"  # its tags are detected by apriltag_ros


@pytest.mark.parametrize(
    ("ros2", "said"),
    [
        (Ros2Settings(connect=("tcp/127.0.0.1:7448",)), "that is the container itself"),
        (Ros2Settings(connect=("tls/host:7448",), keys="keys"), "does not have them"),
    ],
)
def test_a_bridge_that_could_not_work_in_a_container_is_refused(
    ros2: Ros2Settings, said: str
) -> None:
    with pytest.raises(InputError, match=said):
        services_of(replace(team_of(a=robot_at()), ros2=ros2))
    services_of(replace(team_of(a=robot_at()), ros2=Ros2Settings(connect=("tcp/10.0.0.2:7447",))))
