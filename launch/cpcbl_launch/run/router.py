"""`cpcbl-team router`: a team's Zenoh router on a machine of its own."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cpcbl_agents.earlier_processes import ALL_TEAMS, repeat_tokens
from cpcbl_agents.watchdog import with_watchdog
from cpcbl_launch.run.admission import admission_control
from cpcbl_team.config import GuardSettings, Team
from cpcbl_transport import topics
from cpcbl_transport.security import Identity, access_control, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import listening_at, open_router
from cpcbl_transport.zenoh_config import guard_rules, router_config

log = logging.getLogger(__name__)

LOOK_S = 0.5


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
    config: Mapping[str, Any],
    title: str,
    stop: Callable[[], bool],
    guards: GuardSettings,
    speed: float = 1.0,
) -> None:
    """Routes until `stop()`; logs where it listens, and who comes and goes. Raises BusError."""
    listen = listening_at(config)
    with (
        open_router(config) as bus,
        admission_control(bus, guards, listen, speed, ALL_TEAMS),
    ):
        repeat_tokens(bus, ALL_TEAMS)
        log.info("%s listens at %s", title, ", ".join(listen))
        bus.watch_liveliness(ALL_TEAMS + topics.ALIVE.at(), PresenceLogger())
        known: dict[str, str] = {}
        is_over = with_watchdog(stop)
        while not is_over():
            present = bus.neighbours()
            for came in present.keys() - known.keys():
                log.info("+ %s (%d linked)", present[came], len(present))
            for went in known.keys() - present.keys():
                log.info("- %s (%d linked)", known[went], len(present))
            known = present
            time.sleep(LOOK_S)
        log.info("%s ends", title)


class PresenceLogger:
    """Logs which robots of which teams come and go, by their liveliness tokens."""

    def __init__(self) -> None:
        self._present: dict[tuple[str, str], str] = {}  # the token of each robot

    def __call__(self, key: str, alive: bool) -> None:
        _, team, topic = key.split("/", 2)
        names = topics.ALIVE.names(topic)
        if names is None:
            return
        robot = team, names["robot"]
        if alive:
            if robot not in self._present:
                log.info("+ robot %s of team %s", robot[1], team)
            self._present[robot] = key
        elif self._present.get(robot) == key:  # else its tier has changed
            del self._present[robot]
            log.info("- robot %s of team %s", robot[1], team)
