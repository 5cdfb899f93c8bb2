"""`cpcbl-team router`: a team's Zenoh router on a machine of its own."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cpcbl_agents.earlier_processes import ALL_TEAMS, repeat_tokens
from cpcbl_launch.run.linked import Declared, client_names, declared_at, stray_inputs
from cpcbl_team.config import Team
from cpcbl_transport.security import Identity, access_control, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import listening_at, open_router
from cpcbl_transport.zenoh_config import guard_rules, router_config

log = logging.getLogger(__name__)

LOOK_S = 0.5
NAMELESS_LOOKS = 4  # before somebody is said to have come who has declared nothing


def team_router(
    team: Team, listen: Sequence[str], connect: Sequence[str], speed: float = 1.0
) -> dict[str, Any]:
    """The configuration of a team's router; without `listen` where its file says.

    A file that does not say gets the endpoint at which robots of this machine look. `connect`:
    the routers of other sites; `speed`: robot time over real time. Raises SecurityError without the
    keys of a secured team.
    """
    here = listen or team.transport.listen or team.transport.usual
    _, credentials = link_of(team, Identity(Role.ROUTER), [*here, *connect])
    guards = guard_rules(team, speed) | access_control(team)
    return router_config(here, connect, guards, credentials)


def run_router(
    config: Mapping[str, Any], title: str, stop: Callable[[], bool], team: Team | None = None
) -> None:
    """Routes until `stop()`; logs where it listens, who comes and goes, and who publishes to nobody
    of `team`. Raises BusError."""
    with open_router(config) as bus:
        repeat_tokens(bus, ALL_TEAMS)
        log.info("%s listens at %s", title, ", ".join(listening_at(config)))
        visitors = Visitors(team)
        while not stop():
            declared = (declared_at(bus.declarations(kind)) for kind in ("publisher", "token"))
            visitors.look(bus.neighbours(), *declared)
            time.sleep(LOOK_S)
        log.info("%s ends", title)


class Visitors:
    """Says once who has come and gone, and whose inputs reach nobody."""

    def __init__(self, team: Team | None) -> None:
        self._team = team
        self._known: dict[str, str] = {}
        self._looks: dict[str, int] = {}  # at those that have no name yet
        self._strays: tuple[str, ...] = ()

    def look(
        self, present: Mapping[str, str], publishers: list[Declared], tokens: list[Declared]
    ) -> None:
        """`present`: who is linked, by id, and where."""
        names = client_names(publishers, tokens)
        self._looks = {client: self._looks.get(client, 0) + 1 for client in present}
        for client, where in present.items():
            name = names.get(client)
            if client not in self._known and (name or self._looks[client] >= NAMELESS_LOOKS):
                self._known[client] = f"{name}, {where}" if name else where
                log.info("+ %s (%d linked)", self._known[client], len(present))
        for client in [c for c in self._known if c not in present]:
            log.info("- %s (%d linked)", self._known.pop(client), len(present))
        strays = () if self._team is None else stray_inputs(self._team, publishers, tokens)
        for text in strays:
            if text not in self._strays:
                log.warning("%s", text)
        self._strays = strays
