"""Which sessions get a link to a router with mutual TLS."""

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh
from support.keys import (
    FIELD,
    OPERATOR,
    R1,
    R2,
    ROUTER,
    TRIPOD,
    again,
    lasting,
    router_of,
    secured_team,
    session,
    shown_by,
    with_credentials,
)
from support.routers import open_router

from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_transport.zenoh_bus import BusError


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
