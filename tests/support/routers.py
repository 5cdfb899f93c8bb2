"""Routers of teams."""

from collections.abc import Mapping, Sequence
from typing import Any

from cpcbl_transport import zenoh_bus
from cpcbl_transport.security import Credentials
from cpcbl_transport.topics import namespace
from cpcbl_transport.zenoh_bus import ZenohBus
from cpcbl_transport.zenoh_config import router_config


def open_router(
    team: str,
    listen: Sequence[str],
    connect: Sequence[str] = (),
    guards: Mapping[str, Any] | None = None,
    credentials: Credentials | None = None,
) -> ZenohBus:
    """The session of a router in a team's namespace. Raises BusError when it cannot listen."""
    config = router_config(listen, connect, guards, credentials)
    return zenoh_bus.open_router(config, namespace(team))
