"""The bus over Zenoh: the only file that imports it. The choices are measured ones.

- One publisher a concrete key: a put without a publisher is uploaded even if nobody listens.
- Sequence numbers of 16 bits: two bytes a message less than Zenoh's 32.
- No multicast: a client finds its router by the endpoint, which the launcher hands it.
- `open` is retried here with a short time-out: a blocked open swallows SIGINT.
- A session that is not closed hangs the interpreter at exit: `with open_bus(...)`.
"""

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import zenoh

from cpcbl_transport.bus import Handle, Publisher, Receive, Watch
from cpcbl_transport.security import Credentials, link_options
from cpcbl_transport.topics import Qos, namespace

log = logging.getLogger(__name__)

OPEN_TIMEOUT_MS = 2000
NO_GUARDS: Mapping[str, Any] = MappingProxyType({})


class BusError(Exception):
    """The bus could not be opened."""


def open_bus(
    team: str,
    connect: Sequence[str],
    give_up: Callable[[], bool] = lambda: False,
    credentials: Credentials | None = None,
) -> "ZenohBus":
    """A client's session below the team's namespace; waits for a router until `give_up()`.

    With credentials every link is mutual TLS. Raises BusError when it gave up.
    """
    options = {
        "mode": "client",
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": OPEN_TIMEOUT_MS,
            "exit_on_failure": True,
            "retry": {
                "period_init_ms": 200,
                "period_max_ms": 1000,
                "period_increase_factor": 2,
            },
        },
        **(link_options(credentials) if credentials else {}),
    }
    reason = "stopped before a router answered"
    while not give_up():
        try:
            return ZenohBus(_open(team, options))
        except zenoh.ZError as error:
            reason = str(error)
            log.info("no router at %s yet", ", ".join(connect))
            time.sleep(0.2)
    raise BusError(f"no router at {', '.join(connect)}: {reason}")


def open_router(
    team: str,
    listen: Sequence[str],
    connect: Sequence[str] = (),
    guards: Mapping[str, Any] = NO_GUARDS,
    credentials: Credentials | None = None,
) -> "ZenohBus":
    """A session that is the team's router. Raises BusError when it cannot listen there.

    `guards`: what `guard_rules` and `access_rules` say; none, and everything is let in.
    """
    options = {
        "mode": "router",
        "listen": {"endpoints": list(listen), "exit_on_failure": True},
        "connect": {"endpoints": list(connect), "timeout_ms": -1, "exit_on_failure": False},
        **(link_options(credentials) if credentials else {}),
        **guards,
    }
    try:
        return ZenohBus(_open(team, options))
    except zenoh.ZError as error:
        raise BusError(f"cannot listen on {', '.join(listen)}: {error}") from error


def _open(team: str, options: dict[str, Any]) -> "zenoh.Session":
    config = zenoh.Config()
    options |= {
        "namespace": namespace(team),
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": False},
    }
    for key, value in options.items():
        config.insert_json5(key, json.dumps(value))
    config.insert_json5("transport/link/tx/sequence_number_resolution", '"16bit"')
    config.insert_json5("transport/link/tx/lease", "2000")
    config.insert_json5("transport/link/tx/keep_alive", "4")
    return zenoh.open(config)


class _Declared:
    """Something declared; the bus keeps it until it is closed, as an unused one would end."""

    def __init__(self, bus: "ZenohBus", undeclare: Callable[[], None]) -> None:
        self._bus, self._undeclare = bus, undeclare
        bus.declared.add(self)

    @property
    def open(self) -> bool:
        return self in self._bus.declared

    def close(self) -> None:
        if self.open:
            self._bus.declared.discard(self)
            self._undeclare()


class _ZenohPublisher(_Declared):
    def __init__(self, bus: "ZenohBus", publisher: "zenoh.Publisher") -> None:
        super().__init__(bus, publisher.undeclare)
        self._publisher = publisher

    @property
    def matching(self) -> bool:
        if not self.open:
            return False
        status: Any = self._publisher.matching_status  # the stubs call it a bool
        return bool(status.matching)

    def put(self, payload: bytes) -> None:
        if self.open:
            self._publisher.put(payload)


class ZenohBus:
    """One Zenoh session."""

    def __init__(self, session: "zenoh.Session") -> None:
        self._session = session
        self.declared: set[_Declared] = set()

    def publisher(self, key: str, qos: Qos) -> Publisher:
        priority, when_full, reliable, express = qos.value
        kind = zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT
        return _ZenohPublisher(
            self,
            self._session.declare_publisher(
                key,
                allowed_destination=zenoh.Locality.REMOTE,
                priority=getattr(zenoh.Priority, priority),
                congestion_control=getattr(zenoh.CongestionControl, when_full),
                reliability=kind,
                express=express,
            ),
        )

    def subscribe(self, keys: str, receive: Receive) -> Handle:
        def on_sample(sample: "zenoh.Sample") -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                receive(str(sample.key_expr), sample.payload.to_bytes())

        return _Declared(self, self._session.declare_subscriber(keys, on_sample).undeclare)

    def announce(self, key: str) -> Handle:
        return _Declared(self, self._session.liveliness().declare_token(key).undeclare)

    def watch(self, keys: str, watch: Watch) -> Handle:
        def on_sample(sample: "zenoh.Sample") -> None:
            watch(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        liveliness = self._session.liveliness()
        subscriber = liveliness.declare_subscriber(keys, on_sample, history=True)
        return _Declared(self, subscriber.undeclare)

    def close(self) -> None:
        self.declared.clear()
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> "ZenohBus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
