"""A message that names another robot than its key does is refused."""

import json
import threading
from pathlib import Path

import pytest
from support.keys import R1, router_of, secured_team, session
from support.processes import cpcbl_team

from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Drive, Refusal, Status, Track, encode
from cpcbl_transport.topics import Qos

LIES = (
    Status("r2", "1", 1, 0.1, 0.1, 3, "", {}, 0, 0, 0, 0),
    Track("r2", 1, 0.0, 0.0, 0.0, None, 3),
    Drive("r2", 1, 1.0, 0.0),
)


@pytest.mark.parametrize("lie", LIES, ids=lambda m: type(m).__name__)
def test_a_name_in_a_payload_is_that_of_its_key(lie: Status | Track | Drive) -> None:
    (topic,) = [t for t in topics.TOPICS if t.carries is type(lie)]
    assert decode(topic.at(robot="r2"), encode(lie)) == lie
    assert decode(topic.at(robot="r1"), encode(lie)) is Refusal.NOT_ITS_OWN
    assert decode("in/r2/odometry", encode(lie)) is Refusal.WRONG_TYPE
    assert decode("field/nothing", encode(lie)) is Refusal.WRONG_TYPE
    assert decode(topic.at(robot="r2"), b"") is Refusal.EMPTY


def test_operators_are_not_told_lies_about_others(tmp_path: Path) -> None:
    team = secured_team(tmp_path)
    endpoint = free_endpoint("tls")
    with router_of(team, endpoint), session(team, R1, endpoint) as robot:
        stop = threading.Event()

        def lie_and_not() -> None:
            said = [
                (robot.publisher(topics.STATUS.at(robot="r1"), Qos.TELEMETRY), name)
                for name in ("r1", "r2")
            ]
            while not stop.wait(0.05):
                for publisher, name in said:
                    publisher.put(encode(Status(name, "1", 1, 0.1, 0.1, 3, "", {}, 0, 0, 0, 0)))

        speaking = threading.Thread(target=lie_and_not)
        speaking.start()
        try:
            seen = cpcbl_team(
                *("traffic", _written(team, tmp_path), "--connect", endpoint),
                *("--duration", 2, "--json"),
            )
        finally:
            stop.set()
            speaking.join()
    assert list(json.loads(seen.stdout)["robots"]) == ["r1"]


def _written(team: Team, folder: Path) -> Path:
    from cpcbl_launch.team.file import save_resolved

    path = folder / "team.json"
    save_resolved(team, path)
    return path
