"""Who may keep its sessions at a router: the rule, and a router of a team with keys."""

import socket
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress

import pytest
import zenoh
from msgspec.structs import replace
from support.keys import OPERATOR, R1, R2, router_of, secured_team, session
from support.processes import eventually

from cpcbl_launch.run.admission import (
    BARRED_S,
    COUNTED_S,
    CROWDED,
    PAUSE_S,
    Admission,
    admission_control,
    defer_accepting,
    mute,
    ports_of,
    shut_down,
)
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import GuardSettings, Team
from cpcbl_transport import topics
from cpcbl_transport.zenoh_bus import PeerLink, ZenohBus

GUARDS = GuardSettings(sessions_per_member=2, sessions_per_address=3, tokens_per_s=10.0)


def links(count: int, member: str = "", host: str = "192.168.1.7") -> list[PeerLink]:
    return [PeerLink(f"{member}{n}", f"{host}:{40_000 + n}", member) for n in range(count)]


def refused(
    admission: Admission, present: Iterable[PeerLink], now_s: float = 0.0
) -> list[PeerLink]:
    barred, too_many = admission.refused(present, now_s)
    return [link for link, _ in (*barred, *too_many)]


# Sessions ---------------------------------------------------------------------------------------


def test_a_member_keeps_the_sessions_that_it_opened_first() -> None:
    admission, mine, other = Admission(GUARDS), links(3, "robot/r1"), links(2, "robot/r2")
    assert not refused(admission, mine[1:])
    assert refused(admission, [*mine, *other]) == [mine[0]]  # the one that came last
    assert not refused(admission, [*mine[1:], *other], 5.0)


def test_without_keys_an_address_has_a_limit() -> None:
    near, far = links(3), links(3, host="192.168.1.8")
    assert not refused(Admission(GUARDS), near + far)
    assert len(refused(Admission(GUARDS), links(4) + far)) == 1


def test_a_router_of_another_site_has_as_many_links_as_it_needs() -> None:
    assert not refused(Admission(GUARDS), links(5, "router"))


def test_one_session_a_second_is_closed_while_there_are_places() -> None:
    admission, many = Admission(GUARDS), links(20, "robot/r1")
    assert len(refused(admission, many)) == 1
    assert not refused(admission, many, 0.5 * PAUSE_S)
    assert len(refused(admission, many, 1.5 * PAUSE_S)) == 1


def test_all_that_are_too_many_are_closed_when_places_run_out() -> None:
    many = links(CROWDED, "robot/r1")
    assert len(refused(Admission(GUARDS), many)) == 1
    other = links(1, "robot/r2")
    assert refused(Admission(GUARDS), many + other).count(other[0]) == 0
    assert len(refused(Admission(GUARDS), many + other)) == CROWDED - GUARDS.sessions_per_member


# Tokens -----------------------------------------------------------------------------------------


def barred(speed: float = 1.0, changes: int = 11) -> Admission:
    admission = Admission(GUARDS, speed)
    refused(admission, [], 10.0)
    for _ in range(changes):
        admission.count_token("r1")
    return admission


@pytest.mark.parametrize("member", ["robot/r1", "observer/r1", "robot/r1/2"])
def test_whose_tokens_change_too_often_is_refused_for_a_time(member: str) -> None:
    present = [*links(1, member), *links(1, "robot/r11"), *links(1, "operator"), *links(1)]
    admission = barred()
    assert refused(admission, present, 10.1) == present[:1]
    assert refused(admission, present, 10.0 + BARRED_S) == present[:1]
    assert not refused(admission, present, 10.2 + BARRED_S)


def test_tokens_may_change_as_often_as_the_guard_says() -> None:
    mine = links(1, "robot/r1")
    assert not refused(barred(changes=10), mine, 10.1)
    assert not refused(barred(speed=4.0, changes=40), mine, 10.1)
    admission = barred(changes=9)
    refused(admission, mine, 10.1 + COUNTED_S)
    for _ in range(9):
        admission.count_token("r1")
    assert not refused(admission, mine, 10.2 + COUNTED_S)  # in another second


# Connections ------------------------------------------------------------------------------------


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as one:
        one.settimeout(20.0)
        yield one


def test_only_the_connections_to_these_peers_are_shut_down(listener: socket.socket) -> None:
    with ExitStack() as stack:
        clients = [
            stack.enter_context(socket.create_connection(listener.getsockname())) for _ in range(2)
        ]
        served = [stack.enter_context(listener.accept()[0]) for _ in range(2)]
        for local in socket.socketpair():  # whose peers have no host
            stack.enter_context(local)
        host, port = clients[0].getsockname()
        assert shut_down([f"[::ffff:{host}]:{port}"]) == 1
        assert clients[0].recv(1) == served[0].recv(1) == b""
        clients[1].sendall(b"x")
        assert served[1].recv(1) == b"x"
    assert shut_down([]) == shut_down(["127.0.0.1:1"]) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="Linux")
def test_nothing_comes_from_a_muted_peer(listener: socket.socket) -> None:
    with ExitStack() as stack:
        clients = [
            stack.enter_context(socket.create_connection(listener.getsockname())) for _ in range(2)
        ]
        served = [stack.enter_context(listener.accept()[0]) for _ in range(2)]
        assert mute(["{}:{}".format(*clients[0].getsockname())]) == 1
        for client in clients:
            client.sendall(b"x")
        assert served[1].recv(1) == b"x"
        served[0].setblocking(False)
        with pytest.raises(BlockingIOError):
            served[0].recv(1)


def test_ports_are_those_of_endpoints() -> None:
    assert ports_of(["tls/[::]:7447", "tcp/0.0.0.0:7448#a=b", "unixsock-stream/x"]) == {7447, 7448}


@pytest.mark.skipif(not hasattr(socket, "TCP_DEFER_ACCEPT"), reason="Linux")
def test_a_connection_that_says_nothing_does_not_reach_the_listener(
    listener: socket.socket,
) -> None:
    where = listener.getsockname()
    assert defer_accepting([where[1]]) == 1
    with socket.create_connection(where), socket.create_connection(where) as speaks:
        speaks.sendall(b"x")
        with listener.accept()[0] as first:
            assert first.getpeername() == speaks.getsockname()
        listener.setblocking(False)
        with pytest.raises(BlockingIOError):
            listener.accept()


# A router ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Team:
    team = secured_team(tmp_path_factory.mktemp("keys"))
    return replace(team, transport=replace(team.transport, guards=GUARDS))


@contextmanager
def admitting(team: Team) -> Iterator[tuple[ZenohBus, str]]:
    endpoint = free_endpoint("tls")
    with router_of(team, endpoint) as (bus, _):
        assert isinstance(bus, ZenohBus)
        with admission_control(bus, team.transport.guards, [endpoint]):
            yield bus, endpoint


def of(bus: ZenohBus, member: str) -> Sequence[PeerLink]:
    return [link for link in bus.links() if link.member == member]


def test_a_router_closes_the_sessions_of_a_member_that_has_too_many(
    team: Team, caplog: pytest.LogCaptureFixture
) -> None:
    with admitting(team) as (bus, endpoint), ExitStack() as stack:
        stack.enter_context(session(team, R2, endpoint))
        kept = of(bus, "robot/r2")
        for _ in range(3):
            stack.enter_context(session(team, R1, endpoint))
        assert eventually(lambda: "robot/r1: it has 2 sessions already" in caplog.text)
        assert of(bus, "robot/r2") == kept


def test_a_router_refuses_a_member_whose_tokens_change_too_often(
    team: Team, caplog: pytest.LogCaptureFixture
) -> None:
    keys = [topics.ALIVE.at(tier=3, robot="r1", incarnation=f"t{n}") for n in range(200)]
    with admitting(team) as (bus, endpoint), session(team, R2, endpoint) as other:
        kept = of(bus, "robot/r2")
        other.watch_liveliness(topics.ALIVE.at(), lambda key, alive: None)
        with suppress(zenoh.ZError), session(team, R1, endpoint) as loud:  # its end is not heard
            for key in keys:
                loud.declare_token(key).close()
            assert eventually(lambda: "robot/r1: its liveliness tokens changed" in caplog.text)
        assert of(bus, "robot/r2") == kept


@pytest.mark.skipif(not hasattr(socket, "TCP_DEFER_ACCEPT"), reason="Linux")
def test_connections_that_say_nothing_keep_no_member_out(team: Team) -> None:
    with admitting(team) as (bus, endpoint), ExitStack() as stack:
        host, _, port = endpoint.partition("/")[2].rpartition(":")
        silent = [
            stack.enter_context(socket.create_connection((host, int(port)))) for _ in range(50)
        ]
        with session(team, OPERATOR, endpoint):
            assert eventually(lambda: len(of(bus, "operator")) == 1)
        ends = ["{}:{}".format(*one.getsockname()) for one in silent]
        assert shut_down(ends) == 0  # the router has accepted none of them
