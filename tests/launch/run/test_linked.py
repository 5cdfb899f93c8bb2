"""Who is linked to a router, and whose inputs reach nobody."""

import logging

import pytest
from support.buses import robot_at

from cpcbl_launch.run.linked import Declared, client_names, declared_at, stray_inputs
from cpcbl_launch.run.router import NAMELESS_LOOKS, Visitors
from cpcbl_team.config import Team

TEAM = Team(name="lab", robots={"r1": robot_at(), "r2": robot_at()})
ROBOT = Declared("cpcbl/lab/ran/r1/still/0a", ("A",))
FEEDS_R1 = Declared("cpcbl/lab/in/r1/odometry", ("B",))


def feeds(team: str, robot: str, client: str = "C") -> Declared:
    return Declared(f"cpcbl/{team}/in/{robot}/odometry", (client,))


def test_clients_are_named_by_what_they_declared() -> None:
    field = [feeds("lab", "r1", "F"), feeds("lab", "r2", "F")]
    truth = Declared("cpcbl/lab/field/truth", ("F",))
    own = Declared("cpcbl/lab/in/r1/sightings", ("A",))  # a robot with a camera's program inside
    names = client_names([FEEDS_R1, *field, truth, own], [ROBOT])
    assert names == {
        "A": "robot r1 of team lab",
        "B": "driver of r1 of team lab",
        "F": "field of team lab",
    }
    assert declared_at({ROBOT.key: ROBOT.clients, "other/key": ("X",)}) == [ROBOT]


@pytest.mark.parametrize(
    ("publisher", "said"),
    [
        (feeds("lab", "r2"), ()),  # that has not started yet
        (feeds("labb", "r1"), ("this team is `lab`; somebody publishes to `labb` (in/r1)",)),
        (
            feeds("lab", "R1"),
            ("somebody publishes to in/R1; no robot `R1` is there; is it `r1`?",),
        ),
        (feeds("lab", "tripod"), ("somebody publishes to in/tripod; no robot `tripod` is there",)),
        (Declared("cpcbl/labb/status/r1", ("C",)), ()),
    ],
)
def test_inputs_that_reach_nobody_are_said(publisher: Declared, said: tuple[str, ...]) -> None:
    assert stray_inputs(TEAM, [FEEDS_R1, publisher], [ROBOT]) == said


def test_another_team_that_is_there_and_a_guest_are_no_strays() -> None:
    publishers = [feeds("labb", "r1"), feeds("lab", "tripod")]
    tokens = [Declared("cpcbl/labb/alive/3/r1/0b"), Declared("cpcbl/lab/alive/3/tripod/0c")]
    assert stray_inputs(TEAM, publishers, tokens) == ()


def test_a_router_says_once_who_came_went_or_reaches_nobody(
    caplog: pytest.LogCaptureFixture,
) -> None:
    visitors, wrong = Visitors(TEAM), feeds("labb", "r1")
    here = {"A": "client at tcp/a", "Z": "client at tcp/z"}
    with caplog.at_level(logging.INFO):
        for _ in range(NAMELESS_LOOKS + 1):
            visitors.look(here, [wrong], [ROBOT])
        visitors.look({}, [], [])
    assert [record.message for record in caplog.records] == [
        "+ robot r1 of team lab, client at tcp/a (2 linked)",
        "this team is `lab`; somebody publishes to `labb` (in/r1)",
        "+ client at tcp/z (2 linked)",
        *(
            "- robot r1 of team lab, client at tcp/a (0 linked)",
            "- client at tcp/z (0 linked)",
        ),
    ]
