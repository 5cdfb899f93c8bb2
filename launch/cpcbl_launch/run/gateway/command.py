"""Runs the gateway of a team: tokens, keys, its session on the bus, and the server."""

import asyncio
import logging
import os
import ssl
from collections.abc import Callable, Sequence
from pathlib import Path

from cpcbl_launch.run.gateway.server import serve
from cpcbl_launch.run.gateway.tokens import VARIABLE, GuestTokens, tokens_for
from cpcbl_team.config import GatewaySettings, Team
from cpcbl_transport.security import Credentials, Identity, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

log = logging.getLogger(__name__)

LOCAL = ("127.0.0.1", "::1", "localhost")


def run_gateway(
    team: Team, settings: GatewaySettings, connect: Sequence[str], stop: Callable[[], bool]
) -> None:
    """Serves the robots of a team until `stop()`. Raises InputError for tokens or an address that
    cannot be used, BusError when stopped before a router answered, SecurityError without the keys
    of a secured team."""
    path = Path(settings.tokens)
    tokens = tokens_for(team.robots, path, os.environ)
    driven = {name for name, robot in team.robots.items() if robot.source == "external"}
    link = link_of(team, Identity(Role.GATEWAY), connect)
    is_in_file = not os.environ.get(VARIABLE)
    where = f"in {path}" if is_in_file else f"in {VARIABLE}"
    guests = GuestTokens(team, path, tokens, driven)
    with open_bus(team.name, link.endpoints, stop, link.credentials) as bus:
        log.info("connected to the router at %s", ", ".join(link.endpoints))

        def on_start(address: str) -> None:
            log.info("gateway of team %s at %s; tokens %s", team.name, address, where)
            if settings.host not in LOCAL and link.credentials is None:
                log.warning("without keys the tokens are not encrypted: trust this network")

        watch = RouterWatch(bus, ", ".join(link.endpoints))

        def on_look() -> None:
            watch.look()
            if is_in_file and team.guests.allowed:
                guests.look()

        tls = server_tls(link.credentials)
        asyncio.run(serve(settings, tokens, driven, bus, tls, stop, on_look, on_start))


def server_tls(credentials: Credentials | None) -> ssl.SSLContext | None:
    """The gateway's own certificate, for HTTPS; None in a team without keys."""
    if credentials is None:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(credentials.certificate, credentials.private_key)
    return context


class RouterWatch:
    """Says when the router is lost and when it is back."""

    def __init__(self, bus: ZenohBus, where: str) -> None:
        self._bus, self._where, self._is_lost = bus, where, False

    def look(self) -> None:
        is_lost = not self._bus.neighbours()
        if is_lost is not self._is_lost:
            self._is_lost = is_lost
            text = "lost the router at %s" if is_lost else "connected to the router at %s again"
            log.warning(text, self._where)
