"""Who may publish and subscribe to what, with certified names."""

import json
from contextlib import closing
from pathlib import Path

import pytest
import zenoh
from msgspec.structs import replace
from support.buses import Subscription, wait_until
from support.keys import (
    FIELD,
    OPERATOR,
    R1,
    R2,
    ROUTER,
    TRIPOD,
    again,
    secured_team,
    session,
    shown_by,
)
from support.routers import open_router
from support.secured_team import MARK, say

from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import GatewaySettings, Team
from cpcbl_transport import topics
from cpcbl_transport.security import (
    Identity,
    Link,
    Member,
    SecurityError,
    access_control,
    access_rules,
    link_of,
    link_options,
    members_in,
    publish_keys,
    subscribe_keys,
)
from cpcbl_transport.topics import Qos, Role
from cpcbl_transport.zenoh_config import router_config

OWN_ROBOT = {
    *("belief/3/r1", "fix/r2/3/r1", "status/r1", "track/r1", "look/r1", "field/drive/r1"),
    *("in/r1/odometry", "in/r1/sightings", "in/r1/position", "in/r1/initial_pose", "in/r1/frame"),
    *("pose/r1", "pose/r1/json", "status/r1/json"),
}
OWN_OBSERVER = {
    *("belief/3/tripod", "fix/r1/3/tripod", "fix/r2/3/tripod", "status/tripod", "track/tripod"),
    *("field/join/tripod", "field/drive/tripod"),  # its own body on the simulated field
    *("in/tripod/odometry", "in/tripod/sightings", "in/tripod/position"),
    "in/tripod/initial_pose",
    *("look/tripod", "in/tripod/frame", "pose/tripod", "pose/tripod/json", "status/tripod/json"),
}
OWN_FIELD = {
    *("field/truth", "in/*/odometry"),  # to all robots at once
    *(f"in/{name}/odometry" for name in ("r1", "r2", "tripod")),
    *(f"in/{name}/sightings" for name in ("r1", "r2", "tripod")),
    *(f"in/{name}/position" for name in ("r1", "r2", "tripod")),
    *(f"in/{name}/initial_pose" for name in ("r1", "r2", "tripod")),
    *(f"in/{name}/frame" for name in ("r1", "r2", "tripod")),
}
KEYS = sorted(
    {
        *(OWN_ROBOT | OWN_OBSERVER | OWN_FIELD),
        *(key.replace("r1", "r2") for key in OWN_ROBOT if "r2" not in key),
        *("fix/r1/3/r2", "fix/tripod/3/r2", "status/r1/more"),
        *("alive/3/r1/1", "anything", "status/router", "in/r1/more", "field/join/r1"),
        *("**", "*/r2", "status/*", "belief/*/*", "fix/*/3/*", "in/*/odometry", "field/**"),
    }
)
SAID = {R1: OWN_ROBOT, TRIPOD: OWN_OBSERVER, FIELD: OWN_FIELD, OPERATOR: set[str]()}


@pytest.mark.parametrize("who", SAID, ids=str)
def test_a_certificate_permits_to_publish_under_its_owners_keys_only(
    team: Team, endpoint: str, who: Identity
) -> None:
    assert who is OPERATOR or SAID[who] < set(KEYS)
    with (
        closing(session(team, OPERATOR, endpoint)) as listener,
        closing(session(team, who, endpoint)) as speaker,
    ):
        ear = Subscription(listener, "**")
        for key in (*KEYS, MARK):
            say(speaker, key)
        wait_until(lambda: MARK in ear.keys)
        assert set(ear.keys) - {MARK} == SAID[who]


def test_without_access_control_the_same_would_arrive(team: Team) -> None:
    where = free_endpoint("tls")
    with (
        open_router(team.name, [where], credentials=shown_by(team, ROUTER)),
        closing(session(team, OPERATOR, where)) as listener,
        closing(session(team, R1, where)) as speaker,
    ):
        ear = Subscription(listener, "**")
        for key in KEYS:
            say(speaker, key)
        wait_until(lambda: ear.keys == KEYS)


def test_a_token_is_announced_under_ones_own_name_only(team: Team, endpoint: str) -> None:
    seen: dict[str, bool] = {}
    with (
        closing(session(team, OPERATOR, endpoint)) as watcher,
        closing(session(team, R1, endpoint)) as robot,
        closing(session(team, TRIPOD, endpoint)) as observer,
        closing(session(team, OPERATOR, endpoint)) as operator,
    ):
        watcher.watch_liveliness("**", seen.__setitem__)
        for bus, own in ((operator, None), (observer, "tripod"), (robot, "r1")):
            for name in ("r2", "tripod", "r1", own):
                if name != own or name is None:
                    bus.declare_token(
                        topics.ALIVE.at(tier=3, robot=name or "r1", incarnation="false")
                    )
            for pattern in ("**", "alive/**", "alive/3/*/1"):
                bus.declare_token(pattern)
            if own is not None:
                bus.declare_token(topics.ALIVE.at(tier=3, robot=own, incarnation="true"))
        wait_until(lambda: len(seen) >= 2)
        for bus in (operator, observer, robot):
            ear = Subscription(watcher, MARK)
            say(bus, MARK)
            wait_until(lambda ear=ear: bool(ear.samples))  # type: ignore[misc]
        assert seen == {"alive/3/r1/true": True, "alive/3/tripod/true": True}
        robot.close()
        wait_until(lambda: seen["alive/3/r1/true"] is False)


def test_two_sessions_may_show_the_same_certificate(team: Team, endpoint: str) -> None:
    with (
        closing(session(team, R1, endpoint)) as robot,
        closing(session(team, R1, endpoint)) as driver,
    ):
        ear = Subscription(robot, "in/r1/odometry")
        say(driver, "in/r1/odometry", b"a piece")
        wait_until(lambda: ear.payloads == [b"a piece"])


HEARD = {
    R2: {"belief/3/r1", "fix/r2/3/r1"},
    TRIPOD: {"belief/3/r1"},
    FIELD: {"field/drive/r1"},
    OPERATOR: {*OWN_ROBOT, "fix/tripod/3/r1"},
}
ASKED = (
    *("**", "belief/*/*", "fix/*/*/*", "fix/r2/3/*", "status/*", "track/r1"),
    *("in/r1/odometry", "in/**", "look/*", "field/drive/*", "field/**"),
)


@pytest.mark.parametrize("who", HEARD, ids=str)
def test_a_certificate_permits_to_receive_what_is_for_its_owner_only(
    team: Team, endpoint: str, who: Identity
) -> None:
    """Of all that r1 says, whatever is subscribed to."""
    with (
        closing(session(team, who, endpoint)) as listener,
        closing(session(team, R1, endpoint)) as speaker,
        closing(session(team, OPERATOR, endpoint)) as operator,
    ):
        ears, everything = (
            [Subscription(listener, keys) for keys in ASKED],
            Subscription(operator, "**"),
        )
        for key in sorted({*OWN_ROBOT, "fix/tripod/3/r1"}):
            say(speaker, key)
        for key in sorted(HEARD[who]):  # once more, after all that it may not hear
            say(speaker, key, b"last")
        wait_until(lambda: HEARD[who] <= {k for e in ears for k, p in e.samples if p == b"last"})
        wait_until(lambda: HEARD[OPERATOR] <= set(everything.keys))
        assert {key for ear in ears for key in ear.keys} == HEARD[who]
        assert set(everything.keys) == HEARD[OPERATOR]


def test_messages_that_a_robot_may_not_receive_are_not_even_sent(team: Team, endpoint: str) -> None:
    with (
        closing(session(team, R2, endpoint)) as greedy,
        closing(session(team, R1, endpoint)) as robot,
    ):
        ears = [
            Subscription(greedy, keys) for keys in ("**", "fix/r3/*/*", "status/r1", "belief/3/r1")
        ]
        allowed = robot.publisher("belief/3/r1", Qos.FRESH)
        wait_until(lambda: allowed.matching)  # it was asked for last
        for key in ("fix/r3/3/r1", "status/r1", "track/r1", "in/r1/odometry"):
            assert not robot.publisher(key, Qos.FRESH).matching
        assert not any(ear.samples for ear in ears)


def test_the_rules_follow_the_table_of_topics() -> None:
    for topic in topics.TOPICS:
        assert topic.publishers, topic.key
        for speaker in topic.publishers:
            own = {speaker.own: "me"} if speaker.own else {}
            assert topic.at(**own) in publish_keys(
                Identity(speaker.role, "me"), topic.carries is not None
            )
            assert not speaker.own or f"<{speaker.own}>" in topic.key


def test_operators_and_routers_publish_nothing_of_their_own() -> None:
    for carrying in (True, False):
        assert publish_keys(OPERATOR, carrying) == publish_keys(ROUTER, carrying) == []


def test_permitted_subscriptions_follow_the_table_too() -> None:
    me = Identity(Role.ROBOT, "me")
    assert set(subscribe_keys(me)) == {
        *(
            "alive/*/*/*",
            "frame/*/*/*",
            "belief/*/*",
            "fix/me/*/*",
            "landmark/*/*/*",
            "status/me",
            "track/me",
            "look/me",
        ),
        *("pose/*", "pose/*/json", "status/me/json"),
        *(f"in/me/{name}" for name in ("odometry", "sightings", "position", "frame")),
        "in/me/initial_pose",
        "ran/me/*/*",
    }
    assert subscribe_keys(Identity(Role.OBSERVER, "me")) == subscribe_keys(me)
    assert subscribe_keys(FIELD) == ["field/drive/*", "field/join/*"]
    assert subscribe_keys(OPERATOR) == ["**"]


def named_in_rules(team: Team, *members: Member) -> set[str]:
    subjects = access_rules(team, members)["access_control"]["subjects"]
    return {name for subject in subjects for name in subject["cert_common_names"]}


def test_who_has_left_the_team_file_or_was_revoked_has_no_rule(team: Team) -> None:
    members = [
        Member(role=Role.ROBOT, name="r1"),
        Member(role=Role.ROBOT, name="r2", revoked=True),
        Member(role=Role.ROBOT, name="gone"),
        Member(role=Role.OBSERVER, name="tripod", generation=3),
    ]
    assert named_in_rules(team, *members) == {"robot/r1", "observer/tripod/3"}


def test_who_has_no_place_in_the_team_any_more_has_no_rule(team: Team) -> None:
    field, tripod = Member(role=Role.FIELD), Member(role=Role.OBSERVER, name="tripod")
    assert named_in_rules(team, field, tripod) == {"field", "observer/tripod"}
    real = {name: replace(robot, source="external") for name, robot in team.robots.items()}
    assert named_in_rules(replace(team, robots=real), field) == set()
    closed = replace(team, guests=replace(team.guests, allowed=False))
    assert named_in_rules(closed, tripod) == set()
    assert named_in_rules(team, Member(role=Role.OBSERVER, name="r1")) == set()


def test_a_robot_may_be_called_like_a_role(tmp_path: Path) -> None:
    team = secured_team(tmp_path, observers=())
    robots = {"operator": team.robots["r1"], "field": team.robots["r2"]}
    team = replace(team, robots=robots)
    again(team)
    names = [member.common_name for member in members_in(tmp_path)]
    assert {"operator", "field", "robot/operator", "robot/field"} <= set(names)
    assert len(set(names)) == len(names)


def test_a_team_that_is_not_secured_has_no_rules_and_plain_links(team: Team) -> None:
    plain = replace(team, transport=replace(team.transport, security="none"))
    assert access_control(plain) == {}
    assert link_of(plain, R1, ["tcp/a:1"]) == Link(("tcp/a:1",), None)


def test_a_secured_team_has_no_plain_links(team: Team) -> None:
    assert link_of(team, R1, ["tls/a:1"]).credentials == shown_by(team, R1)
    with pytest.raises(SecurityError, match=r"tcp/a:1.*mtls.*tls/a:1"):
        link_of(team, R1, ["tls/b:1", "tcp/a:1"])


def test_absent_keys_are_one_line_with_file_key_and_fix(team: Team, tmp_path: Path) -> None:
    nowhere = replace(team, transport=replace(team.transport, keys=str(tmp_path / "none")))
    for ask in (lambda: link_of(nowhere, R1, ["tls/a:1"]), lambda: access_control(nowhere)):
        with pytest.raises(SecurityError, match=r"transport\.keys: .*none.*cpcbl-team keys") as one:
            ask()
        assert "\n" not in str(one.value)


def test_all_options_are_known_to_zenoh(team: Team) -> None:
    shown = shown_by(team, ROUTER)
    whole = router_config(["tls/127.0.0.1:1"], (), access_control(team), shown)
    config = zenoh.Config.from_json5(json.dumps(whole))
    for name, value in link_options(shown)["tls"].items():
        assert json.loads(config.get_json(f"transport/link/tls/{name}")) == value
    assert json.loads(config.get_json("transport/link/protocols")) == ["tls"]
    assert json.loads(config.get_json("transport/link/tx/lease")) == 2000


def test_a_gateway_speaks_for_all_drivers_and_hears_poses() -> None:
    gateway = Identity(Role.GATEWAY)
    assert set(publish_keys(gateway, carrying=True)) == {topic.at() for topic in topics.INPUTS}
    assert publish_keys(gateway, carrying=False) == []
    assert subscribe_keys(gateway) == ["pose/*", "pose/*/json"]


def test_only_a_team_with_a_gateway_has_a_place_for_one(team: Team) -> None:
    gateway = Member(role=Role.GATEWAY)
    assert named_in_rules(team, gateway) == set()
    assert named_in_rules(replace(team, gateway=GatewaySettings()), gateway) == {"gateway"}
