"""Revoked and renewed certificates, two sites, and what TLS costs."""

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from statistics import mode

import pytest
from support.buses import Subscription, wait_until
from support.keys import (
    OPERATOR,
    PATIENCE_S,
    R1,
    R2,
    REFUSED_S,
    ROUTER,
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
from support.routers import open_router
from support.secured_team import MARK, say

from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.compact import FIX_BYTES
from cpcbl_transport.security import (
    Credentials,
    Identity,
)
from cpcbl_transport.topics import Permission, Qos
from cpcbl_transport.zenoh_bus import BusError


def hears(bus: Bus, speaker: Bus, key: str, within_s: float = PATIENCE_S) -> bool:
    """Whether what one session says reaches another in time."""
    ear, publisher = Subscription(bus, key), speaker.publisher(key, Qos.INPUT)
    eventually(lambda: publisher.matching, within_s)
    publisher.put(b"?")
    heard = eventually(lambda: bool(ear.samples), within_s)
    ear.close()
    publisher.close()
    return heard


def test_a_revoked_robot_neither_publishes_nor_receives_anything(tmp_path: Path) -> None:
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
