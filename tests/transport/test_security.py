"""Real sessions with real certificates: who gets a link, and what a router lets each one say."""

import json
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from statistics import mode
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace
from support.buses import Subscription, wait_until
from support.keys import (
    FIELD,
    OPERATOR,
    PATIENCE_S,
    R1,
    R2,
    REFUSED_S,
    ROUTER,
    TRIPOD,
    SealedRelay,
    again,
    lasting,
    router_of,
    secured_team,
    session,
    shown_by,
    with_credentials,
)
from support.processes import eventually

from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.compact import FIX_BYTES
from cpcbl_transport.security import (
    Credentials,
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
from cpcbl_transport.topics import Permission, Qos, Role
from cpcbl_transport.zenoh_bus import BusError, open_router
from cpcbl_transport.zenoh_config import router_config

MARK = "mark"


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Team:
    return secured_team(tmp_path_factory.mktemp("keys"))


@pytest.fixture(scope="module")
def endpoint(team: Team) -> Iterator[str]:
    """Where the team's router listens. All its members may also say `mark`, for the tests."""
    where = free_endpoint("tls")
    rules = access_control(team)
    access = rules["access_control"]
    mark = {**access["rules"][0], "id": MARK, "flows": ["ingress"], "messages": ["put"]}
    mark["key_exprs"] = [f"{topics.namespace(team.name)}/{MARK}"]
    access["rules"].append(mark)
    access["policies"].append({"rules": [MARK], "subjects": [access["subjects"][0]["id"]]})
    with open_router(team.name, [where], guards=rules, credentials=shown_by(team, ROUTER)):
        yield where


# Who gets a link --------------------------------------------------------------------------------


def config_of(endpoint: str, **tls: Any) -> "zenoh.Config":
    """A client that shows what it likes."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    connect = {"endpoints": [endpoint], "timeout_ms": 2000, "exit_on_failure": True}
    config.insert_json5("connect", json.dumps(connect))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/link/tls", json.dumps(tls))
    return config


def test_every_member_gets_a_link(team: Team, endpoint: str) -> None:
    for identity in (R1, R2, TRIPOD, FIELD, OPERATOR, ROUTER):
        session(team, identity, endpoint).close()


def test_without_a_certificate_there_is_no_session(team: Team, endpoint: str) -> None:
    trusted = {"root_ca_certificate": shown_by(team, R1).ca}
    shown = shown_by(team, R1)
    own = {"connect_certificate": shown.certificate, "connect_private_key": shown.private_key}
    zenoh.open(config_of(endpoint, **trusted, **own, enable_mtls=True)).close()  # type: ignore[no-untyped-call]
    with pytest.raises(zenoh.ZError):
        zenoh.open(config_of(endpoint, **trusted))


def test_with_a_foreign_certificate_there_is_no_session(
    team: Team, endpoint: str, tmp_path: Path
) -> None:
    foreign = shown_by(secured_team(tmp_path), R1)
    for shown, reason in (
        (foreign._replace(ca=shown_by(team, R1).ca), "refuses .*certificate.crt: .* of another"),
        (foreign, "cannot be trusted: unable to get local issuer"),
    ):
        with pytest.raises(BusError, match=reason):
            with_credentials(team, shown, endpoint)


def test_with_an_expired_certificate_there_is_no_session(tmp_path: Path) -> None:
    team = secured_team(tmp_path)
    lasting(team, "r1", -1.0)
    with router_of(team) as (_, endpoint):
        session(team, R2, endpoint).close()
        with pytest.raises(BusError, match=r"refuses .*certificate.crt: it has expired"):
            with_credentials(team, shown_by(team, R1), endpoint)


def test_plain_tcp_is_refused(team: Team, endpoint: str) -> None:
    plain = endpoint.replace("tls/", "tcp/")
    for credentials in (None, shown_by(team, R1)):
        with pytest.raises(BusError):
            with_credentials(team, credentials, plain)


def test_a_secured_router_listens_in_no_other_way(team: Team) -> None:
    for protocol in ("tcp", "quic", "ws"):
        with pytest.raises(BusError), router_of(team, free_endpoint(protocol)):
            pass


def test_a_secured_session_dials_no_plain_router(team: Team) -> None:
    plain = free_endpoint()
    with open_router(team.name, [plain]):
        with_credentials(team, None, plain).close()
        with pytest.raises(BusError):
            with_credentials(team, shown_by(team, R1), plain)
        with pytest.raises(BusError, match="does not speak TLS"):
            with_credentials(team, shown_by(team, R1), plain.replace("tcp/", "tls/"))


def test_a_router_with_a_foreign_certificate_is_not_trusted(team: Team, tmp_path: Path) -> None:
    with router_of(secured_team(tmp_path)) as (_, endpoint), pytest.raises(BusError):
        with_credentials(team, shown_by(team, R1), endpoint)


def test_a_robot_cannot_pass_for_the_router(team: Team) -> None:
    where = free_endpoint("tls")
    with (
        open_router(team.name, [where], credentials=shown_by(team, R2)),
        pytest.raises(BusError, match="cannot be trusted"),
    ):
        with_credentials(team, shown_by(team, R1), where)


def test_a_router_is_trusted_where_its_certificate_says(tmp_path: Path) -> None:
    team = secured_team(tmp_path)
    where = free_endpoint("tls").replace("127.0.0.1", "127.0.0.2")
    with router_of(team, where), pytest.raises(BusError, match=r"not valid for '127\.0\.0\.2'"):
        with_credentials(team, shown_by(team, R1), where)
    again(team, hosts=("127.0.0.2",), renew=("router",))
    with router_of(team, where):
        session(team, R1, where).close()
    with router_of(team, where.replace("127.0.0.2", "0.0.0.0")):
        for host in ("127.0.0.1", "localhost"):  # what it had before it has still
            session(team, R1, where.replace("127.0.0.2", host)).close()


# Who may say what -------------------------------------------------------------------------------

OWN_ROBOT = {
    *("belief/3/r1", "fix/r2/3/r1", "status/r1", "track/r1", "look/r1", "field/drive/r1"),
    *("in/r1/odometry", "in/r1/sightings", "in/r1/position", "in/r1/frame"),
}
OWN_OBSERVER = {
    *("belief/3/tripod", "fix/r1/3/tripod", "fix/r2/3/tripod", "status/tripod", "track/tripod"),
    *("field/join/tripod", "field/drive/tripod"),  # its own body on the simulated field
    *("in/tripod/odometry", "in/tripod/sightings", "in/tripod/position"),
    *("look/tripod", "in/tripod/frame"),
}
OWN_FIELD = {
    *("field/truth", "in/*/odometry"),  # to all robots at once
    *(f"in/{name}/odometry" for name in ("r1", "r2", "tripod")),
    *(f"in/{name}/sightings" for name in ("r1", "r2", "tripod")),
    *(f"in/{name}/position" for name in ("r1", "r2", "tripod")),
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


def say(bus: Bus, key: str, payload: bytes = b"?") -> None:
    publisher = bus.publisher(key, Qos.INPUT)
    wait_until(lambda: publisher.matching)
    publisher.put(payload)


@pytest.mark.parametrize("who", SAID, ids=str)
def test_a_certificate_says_what_is_its_owners_and_nothing_else(
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


# Who may hear what ------------------------------------------------------------------------------

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
def test_a_certificate_hears_what_is_for_its_owner_and_nothing_else(
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


def test_what_a_robot_may_not_hear_is_not_even_sent(team: Team, endpoint: str) -> None:
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


# The rules are the table's ----------------------------------------------------------------------


def test_the_rules_follow_the_table_of_topics() -> None:
    for topic in topics.TOPICS:
        assert topic.publishers, topic.key
        for speaker in topic.publishers:
            own = {speaker.own: "me"} if speaker.own else {}
            assert topic.at(**own) in publish_keys(Identity(speaker.role, "me"))
            assert not speaker.own or f"<{speaker.own}>" in topic.key


def test_operators_and_routers_say_nothing_of_their_own() -> None:
    assert publish_keys(OPERATOR) == publish_keys(ROUTER) == []


def test_who_may_hear_follows_the_table_too() -> None:
    me = Identity(Role.ROBOT, "me")
    assert set(subscribe_keys(me)) == {
        *("alive/*/*/*", "belief/*/*", "fix/me/*/*", "status/me", "track/me", "look/me"),
        *("in/me/odometry", "in/me/sightings", "in/me/position", "in/me/frame"),
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


# Rotation and revocation ------------------------------------------------------------------------


def hears(bus: Bus, speaker: Bus, key: str, within_s: float = PATIENCE_S) -> bool:
    """Whether what one session says reaches another in time."""
    ear, publisher = Subscription(bus, key), speaker.publisher(key, Qos.INPUT)
    eventually(lambda: publisher.matching, within_s)
    publisher.put(b"?")
    heard = eventually(lambda: bool(ear.samples), within_s)
    ear.close()
    publisher.close()
    return heard


def test_a_revoked_robot_neither_says_nor_hears_anything(tmp_path: Path) -> None:
    team = secured_team(tmp_path)
    stolen = shown_by(team, R2)
    kept = [path.read_bytes() for path in map(Path, stolen)]
    again(team, revoke=("r2",))
    with (
        router_of(team) as (_, endpoint),
        closing(session(team, R1, endpoint)) as good,
        closing(with_credentials(team, stolen, endpoint, PATIENCE_S)) as out,
        closing(session(team, OPERATOR, endpoint)) as operator,
    ):
        assert hears(operator, good, "status/r1")
        assert not hears(operator, out, "status/r2", REFUSED_S)
        assert not hears(out, good, "belief/3/r1", REFUSED_S)
    again(team, renew=("r2",))
    old = [tmp_path / name for name in ("old-ca.crt", "old.crt", "old.key")]
    for path, content in zip(old, kept, strict=True):
        path.write_bytes(content)
    with (
        router_of(team) as (_, endpoint),
        closing(session(team, R2, endpoint)) as back,
        closing(with_credentials(team, type(stolen)(*map(str, old)), endpoint)) as out,
        closing(session(team, OPERATOR, endpoint)) as operator,
    ):
        assert hears(operator, back, "status/r2")
        assert not hears(operator, out, "status/r2", REFUSED_S)


def test_a_link_ends_with_its_certificate_and_a_renewed_one_opens_the_next(
    tmp_path: Path,
) -> None:
    team = secured_team(tmp_path)
    alive: list[tuple[str, bool]] = []
    lasting(team, "r1", 6.0)
    with (
        router_of(team) as (router, endpoint),
        closing(session(team, R1, endpoint)) as robot,
    ):
        router.watch_liveliness("alive/**", lambda *news: alive.append(news))
        key = topics.ALIVE.at(tier=3, robot="r1", incarnation="1")
        robot.declare_token(key)
        wait_until(lambda: alive == [(key, True)])
        assert eventually(lambda: alive == [(key, True), (key, False)])
        assert not eventually(lambda: len(alive) > 2, REFUSED_S)
        again(team, renew=("r1",))
        assert eventually(lambda: alive[2:] == [(key, True)])


def test_two_authorities_overlap_until_the_old_one_is_retired(tmp_path: Path) -> None:
    team = secured_team(tmp_path)
    old = {identity: shown_by(team, identity) for identity in (R1, R2, OPERATOR)}
    copies = {}
    for identity, shown in old.items():  # as they are on machines that nobody has been to
        paths = [tmp_path / f"{identity.role}{identity.name}{n}" for n in range(3)]
        for path, source in zip(paths, shown, strict=True):
            path.write_bytes(Path(source).read_bytes())
        copies[identity] = type(shown)(*map(str, paths))
    again(team, renew=("ca",))
    with router_of(team) as (_, endpoint):  # it still shows a certificate of the old authority
        with_credentials(team, copies[R1], endpoint, PATIENCE_S).close()
    with pytest.raises(InputError, match=r"--retire-ca.*--renew all"):
        again(team, retire_ca=True)
    again(team, renew=("all",))
    with router_of(team) as (_, endpoint):
        session(team, R2, endpoint).close()
        only_new_ca = copies[R1]._replace(ca=shown_by(team, R1).ca)
        with_credentials(team, only_new_ca, endpoint, PATIENCE_S).close()
    again(team, retire_ca=True)
    with router_of(team) as (_, endpoint):
        session(team, R2, endpoint).close()
        with pytest.raises(BusError):
            with_credentials(team, only_new_ca, endpoint)


# Two sites --------------------------------------------------------------------------------------


def test_two_routers_relay_what_each_lets_in(team: Team) -> None:
    with (
        router_of(team) as (_, west),
        router_of(team, "", west) as (_, east),
        closing(session(team, R1, west)) as r1,
        closing(session(team, R2, east)) as r2,
    ):
        beliefs, fixes = Subscription(r2, "belief/3/*"), Subscription(r2, "fix/r2/3/*")
        tokens: dict[str, bool] = {}
        r2.watch_liveliness("alive/*/*/*", tokens.__setitem__)
        r1.declare_token("alive/3/r1/1")
        say(r1, "belief/3/r2", b"as another")
        say(r1, "fix/r2/3/r1", b"as itself")
        wait_until(lambda: fixes.payloads == [b"as itself"])
        wait_until(lambda: tokens == {"alive/3/r1/1": True})
        assert beliefs.payloads == []
        assert hears(r1, r2, "belief/3/r2")


def test_a_robot_cannot_join_a_router_as_a_router(team: Team, endpoint: str) -> None:
    plain = free_endpoint("tls")
    with (
        open_router(team.name, [plain], [endpoint], credentials=shown_by(team, R2)) as false,
        closing(session(team, OPERATOR, endpoint)) as operator,
    ):
        ear = Subscription(operator, "**")
        say(false, "status/r1", b"relayed")
        say(false, MARK, b"mark")
        wait_until(lambda: b"mark" in ear.payloads)
        assert ear.payloads == [b"mark"]


# What it costs, and what is written about it ----------------------------------------------------


def written_at_once(team: Team, secured: bool) -> int:
    """Bytes of one fix on its sender's link.

    Zenoh numbers its frames from anywhere, and numbers below 128 take a byte less than others: of
    300 frames, most have the usual size.
    """
    endpoint = free_endpoint("tls" if secured else "tcp")

    def shown(identity: Identity) -> Credentials | None:
        return shown_by(team, identity) if secured else None

    with (
        open_router(team.name, [endpoint], credentials=shown(ROUTER)),
        SealedRelay(endpoint) as link,
        closing(with_credentials(team, shown(R1), link.endpoint, PATIENCE_S)) as robot,
        closing(with_credentials(team, shown(R2), endpoint, PATIENCE_S)) as mate,
    ):
        ear = Subscription(mate, "fix/r2/3/*")
        publisher = robot.publisher("fix/r2/3/r1", Qos.FRESH)
        wait_until(lambda: publisher.matching)
        before = len(link.up)
        for n in range(300):
            publisher.put(bytes(FIX_BYTES))
            wait_until(lambda n=n: len(ear.samples) > n)  # type: ignore[misc]
        return mode(len(batch.content) for batch in link.up[before:])


def test_tls_takes_22_bytes_for_what_is_written_at_once(team: Team) -> None:
    assert written_at_once(team, secured=True) - written_at_once(team, secured=False) == 22


def in_words(who: Iterable[Permission]) -> str:
    return ", ".join(f"{w.role} (`{w.own}`)" if w.own else str(w.role) for w in who)


def test_the_table_in_the_docs_is_that_of_the_topics() -> None:
    text = (Path(__file__).parents[2] / "docs" / "security.md").read_text()
    rows = [
        f"| `{topic.key}` | {in_words(topic.publishers)} | {in_words(topic.subscribers)} |"
        for topic in topics.TOPICS
    ]
    table = text.partition("| key | may publish | may subscribe |\n|---|---|---|\n")[2].partition(
        "\n\n"
    )[0]
    assert table.splitlines() == rows
