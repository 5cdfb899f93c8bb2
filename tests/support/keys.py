"""Teams with keys, and sessions that show them."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import msgspec

from cpcbl_launch.keys.folder import KeyRequest, KeysReport, make_keys
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Field, RobotSettings, Start, Team, TransportSettings
from cpcbl_transport.bus import Bus
from cpcbl_transport.security import Credentials, Identity, access_control, credentials_in
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import open_bus
from cpcbl_transport.zenoh_config import guard_rules
from support.routers import open_router
from support.wire_tap import Batch, Kind, Relay

R1, R2 = Identity(Role.ROBOT, "r1"), Identity(Role.ROBOT, "r2")
TRIPOD = Identity(Role.OBSERVER, "tripod")
FIELD, OPERATOR, ROUTER = Identity(Role.FIELD), Identity(Role.OPERATOR), Identity(Role.ROUTER)
PATIENCE_S = 40.0
REFUSED_S = 1.5  # a session that is let in is open after a tenth of this


def secured_team(folder: Path, observers: tuple[str, ...] = ("tripod",)) -> Team:
    """Two simulated robots whose keys are in `folder`."""
    robots = {name: RobotSettings(start=Start(x_m=0.0, y_m=0.0)) for name in ("r1", "r2")}
    transport = TransportSettings(security="mtls", keys=str(folder))
    team = Team(name="tests", robots=robots, map=Field(), transport=transport)
    again(team, observers=observers)
    return team


def again(team: Team, **wish: object) -> list[KeysReport]:
    """`cpcbl-team keys` once more, with these wishes."""
    return make_keys(team, Path(team.transport.keys), msgspec.convert(wish, KeyRequest))


def lasting(team: Team, name: str, seconds: float) -> None:
    """Gives a member a certificate that ends so soon, or has ended."""
    wish = KeyRequest(renew=(name,), lasting=timedelta(seconds=seconds))
    make_keys(team, Path(team.transport.keys), wish)


def shown_by(team: Team, identity: Identity) -> Credentials:
    return credentials_in(Path(team.transport.keys), identity)


@contextmanager
def router_of(team: Team, endpoint: str = "", *joined: str) -> Iterator[tuple[Bus, str]]:
    """(its session, where it listens) of a secured team's router, as `up` opens it."""
    endpoint = endpoint or free_endpoint("tls")
    rules = guard_rules(team) | access_control(team)
    shown = shown_by(team, ROUTER)
    with open_router(team.name, [endpoint], joined, rules, shown) as bus:
        yield bus, endpoint


def session(team: Team, identity: Identity, endpoint: str) -> Bus:
    """A member's session. Raises BusError when it does not come about."""
    return with_credentials(team, shown_by(team, identity), endpoint, PATIENCE_S)


def with_credentials(
    team: Team, credentials: Credentials | None, endpoint: str, within_s: float = REFUSED_S
) -> Bus:
    until = time.monotonic() + within_s
    return open_bus(team.name, [endpoint], lambda: time.monotonic() > until, credentials)


class SealedRelay(Relay):
    """Between a client and a router like any relay; cannot tell what passes, only how much."""

    def observer(self, upward: bool) -> Callable[[bytes], None]:
        seen = self.up if upward else self.down
        return lambda data: seen.append(Batch(time.monotonic(), Kind.OTHER, data))
