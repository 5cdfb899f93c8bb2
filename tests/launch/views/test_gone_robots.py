"""A robot whose process or link ended is `gone` for list, status and doctor, as on the page."""

from datetime import UTC, datetime

import pytest
from support.buses import robot_at, team_of

from cpcbl_agents.earlier_processes import OwnTokens, repeat_tokens
from cpcbl_launch.views.doctor_checks import findings
from cpcbl_launch.views.doctor_facts import EndpointFacts, Facts
from cpcbl_launch.views.listening import TeamHeard, listen
from cpcbl_launch.views.robot_status import robot_statuses
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, encode
from cpcbl_transport.topics import Qos

TEAM = team_of(r1=robot_at(), r2=robot_at())


def heard_after(end: str) -> TeamHeard:
    """What is heard of r1, whose process ends `before` or `while` somebody listens, or `never`."""
    hub = MemoryHub()
    repeat_tokens(hub.session())
    process = hub.session()
    OwnTokens(process, "r1", "1")
    process.declare_token(topics.ALIVE.at(tier=1, robot="r1", incarnation=1))
    if end == "before":
        process.close()
    stops = iter([False, True])

    def stop() -> bool:
        if end == "while":
            process.close()
        elif end == "never":
            status = Status("r1", "1", 1, 0.01, 0.02, 1, "", {}, 0, 0, 0, 0)
            publisher = process.publisher(topics.STATUS.at(robot="r1"), Qos.TELEMETRY)
            publisher.put(encode(status))
        return next(stops)

    return listen(hub.session(), 5.0, stop, TEAM.name)[TEAM.name]


@pytest.mark.parametrize("end", ["before", "while"])
def test_a_robot_that_ended_is_gone(end: str) -> None:
    heard = heard_after(end)
    assert heard.gone == ["r1"]
    assert heard.robots == []
    r1, r2 = robot_statuses(heard, TEAM)
    assert (r1.state, r1.problems) == ("gone", ("gone: its process or its link ended",))
    assert (r2.state, r2.problems) == ("waiting", ("waiting: nothing was heard",))
    answers = (EndpointFacts(endpoint="tcp/127.0.0.1:7447", answer="open"),)
    facts = Facts(
        now=datetime(2026, 11, 1, tzinfo=UTC),
        python="3.12.0",
        packages={"cpcbl-team": "0.1.0"},
        extras={"camera": True},
        file="team.toml",
        team=TEAM,
        endpoints=answers,
        heard={TEAM.name: heard},
        seconds=2.0,
    )
    texts = [finding.text for finding in findings(facts)]
    assert "r1: sends no status for 2 s: gone, its process or its link ended" in texts


def test_a_robot_that_runs_is_not_gone() -> None:
    heard = heard_after("never")
    assert heard.gone == []
    assert robot_statuses(heard, TEAM)[0].state != "gone"
