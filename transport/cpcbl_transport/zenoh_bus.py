"""The bus over Zenoh: besides `ros2/session.py` the only file that imports Zenoh. Its choices come
from measurements.

- There is one publisher for each concrete key: Zenoh uploads a put without a publisher even if
  nobody subscribes.
- Sequence numbers have 16 bits: this saves two bytes a message against Zenoh's 32.
- Whether there is a subscriber is asked only after a change, for the question can take 40 us.
- Multicast is off: a client finds its router by the endpoint that the launcher gives it.
- `open` is retried here with a short time-out: a blocked `open` ignores SIGINT.
- A session that is not closed hangs the interpreter at exit: write `with open_bus(...)`.
"""

import json
import logging
import os
import re
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from cpcbl_team.errors import CpcblError
from cpcbl_transport.bus import (
    Bus,
    Declared,
    Handle,
    LivelinessCallback,
    MessageCallback,
    Publisher,
)
from cpcbl_transport.security import Credentials
from cpcbl_transport.topics import Qos, is_json_key, namespace
from cpcbl_transport.zenoh_config import client_config

log = logging.getLogger(__name__)

RUNTIME = "ZENOH_RUNTIME"
ROUTER_RUNTIME = "(rx: (worker_threads: 16))"
"""Two by default: two slow receivers held up everybody."""
USUAL_PORT = 7447
TOKENS_S = 5.0  # for the router's answer
LEAST_DESCRIPTORS, MOST_DESCRIPTORS = 64, 65_536
WAITING_S = 10.0  # after so long it is said again that no router answers


class BusError(CpcblError):
    """The bus could not be opened."""


def open_bus(
    team: str,
    connect: Sequence[str],
    give_up: Callable[[], bool] = lambda: False,
    credentials: Credentials | None = None,
    on_wait: Callable[[str], None] | None = None,
) -> "ZenohBus":
    """A client's session below the team's namespace; waits for a router until `give_up()`. With
    credentials every link is mutual TLS. `on_wait` is told again and again that there is none yet,
    with the reason where TLS has one; without it the log says so. Without a team, keys are whole
    ones, of all teams. Raises BusError when it gave up.
    """
    space = namespace(team) if team else None
    return ZenohBus(open_session(connect, client_config, space, give_up, credentials, on_wait))


def open_session(
    connect: Sequence[str],
    config_of: Callable[[Sequence[str], Credentials | None], Mapping[str, Any]] = client_config,
    space: str | None = None,
    give_up: Callable[[], bool] = lambda: False,
    credentials: Credentials | None = None,
    on_wait: Callable[[str], None] | None = None,
) -> "zenoh.Session":
    """A session that connects to a router, as `open_bus` says, below a namespace of keys.

    Each attempt begins with another endpoint: one that accepts and says nothing, or is far behind
    with its handshakes, takes all the time of an attempt.
    """
    require_descriptors()
    reason, said_s, first = "stopped before a router answered", -WAITING_S, True
    begin_with = deque(connect)
    while not give_up():
        config = config_of(begin_with, credentials)
        begin_with.rotate(-1)
        try:
            return _open(config, space)
        except zenoh.ZError as error:
            reason = _tls_reason(connect, credentials) or one_line(str(error))
            if on_wait is not None:
                on_wait(reason if credentials else "")
            elif time.monotonic() - said_s >= WAITING_S:
                said_s = time.monotonic()
                shown = f": {reason}" if credentials else ""
                hint = _port_hint(connect, credentials, first)
                first = False
                where = ", ".join(connect)
                log.warning("no router at %s yet, waiting for it%s%s", where, shown, hint)
            time.sleep(0.2)
    raise BusError(f"no router at {', '.join(connect)}: {reason}")


def _port_hint(connect: Sequence[str], credentials: Credentials | None, first: bool) -> str:
    """What to say of ports to somebody who waits for a router: where one is instead."""
    for head, _, port in (endpoint.rpartition(":") for endpoint in connect):
        usual = f"{head}:{USUAL_PORT}"
        if port != str(USUAL_PORT) and _listens(usual, credentials):
            return f"; a router listens at {usual}, not at {port}: connect there, or move it"
    return "" if first else "; does the router say that it listens at another port?"


def _listens(endpoint: str, credentials: Credentials | None) -> bool:
    """Whether a router answers there at once."""
    config = client_config([endpoint], credentials)
    config["connect"]["timeout_ms"] = 500
    with suppress(zenoh.ZError):
        _open(config).close()  # type: ignore[no-untyped-call]
        return True
    return False


def _tls_reason(connect: Sequence[str], credentials: Credentials | None) -> str:
    """Why TLS fails, which Zenoh does not say; empty without credentials."""
    if credentials is None:
        return ""
    from cpcbl_transport.tls_diagnosis import tls_diagnosis  # only it needs ssl

    reasons = {endpoint: tls_diagnosis(endpoint, credentials) for endpoint in connect}
    return "; ".join(dict.fromkeys(filter(None, reasons.values())))


def open_router(config: Mapping[str, Any], space: str | None = None) -> "ZenohBus":
    """A session that is a router for all teams, as its configuration says. Without a namespace its
    own keys are whole ones. Raises BusError when it cannot listen there."""
    require_descriptors()
    own = RUNTIME not in os.environ  # read once, when Zenoh starts
    os.environ.setdefault(RUNTIME, ROUTER_RUNTIME)
    try:
        return ZenohBus(_open(config, space))
    except zenoh.ZError as error:
        endpoints = ", ".join(listening_at(config))
        raise BusError(f"cannot listen on {endpoints}: {listen_problem(str(error))}") from error
    finally:
        if own:
            del os.environ[RUNTIME]  # child processes are no routers


def read_router_config(path: Path) -> dict[str, Any]:
    """A router's whole configuration from a file (JSON5), with Zenoh's defaults filled in. Raises
    BusError for a file that is none."""
    try:
        read = zenoh.Config.from_json5(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise BusError(f"{path}: cannot be read: {error}") from error
    except zenoh.ZError as error:
        raise BusError(f"{path}: no configuration of Zenoh: {one_line(str(error))}") from error
    config: dict[str, Any] = json.loads(str(read))
    config["mode"] = config["mode"] or "router"
    if config["mode"] != "router":
        raise BusError(f"{path}: mode: is {config['mode']!r}; write 'router'")
    return config


def listening_at(config: Mapping[str, Any]) -> list[str]:
    """The endpoints in a router's configuration, which may list them by mode."""
    endpoints = config["listen"]["endpoints"]
    return list(endpoints["router"] if isinstance(endpoints, Mapping) else endpoints)


LISTEN_PROBLEMS = {  # what the system says, and what that means to a user
    "Address already in use": "another program listens there; end or join it, or name another port",
    "Cannot assign requested address": "no address of this machine; 0.0.0.0 is all of them",
    "failed to lookup address": "no such host; write the address of this machine",
    "Permission denied": "not allowed to this user; name a port from 1024 on",
}


def listen_problem(error: str) -> str:
    """Why a router cannot listen, by Zenoh's error."""
    plain = (text for said, text in LISTEN_PROBLEMS.items() if said in error)
    return next(plain, one_line(error))


def one_line(error: str) -> str:
    """What went wrong, in one line, without the places in Zenoh's source."""
    return " ".join(re.sub(r"(?: at )?\(?/?\S+\.rs:\d+(?::\d+)?\)?[.:]?", "", error).split())


def require_descriptors() -> None:
    """Lets this process open as many files and connections as its system does. Raises BusError
    where these are too few: without them Zenoh aborts the process, or hangs."""
    try:
        import resource
    except ImportError:  # not on Windows, which has no such limit
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < most:
        with suppress(ValueError, OSError):  # macOS may have a lower limit of its own
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
            soft = most
    if soft != resource.RLIM_INFINITY and soft < LEAST_DESCRIPTORS:
        raise BusError(
            f"this process may open only {soft} files and connections, and needs"
            f" {LEAST_DESCRIPTORS}; run `ulimit -n 1024` before (systemd: LimitNOFILE=)"
        )


def _open(config: Mapping[str, Any], space: str | None = None) -> "zenoh.Session":
    whole = {**config, "namespace": space} if space else dict(config)
    return zenoh.open(zenoh.Config.from_json5(json.dumps(whole)))


class _ZenohPublisher(Declared):
    def __init__(self, bus: "ZenohBus", publisher: "zenoh.Publisher") -> None:
        super().__init__(bus.declared, publisher.undeclare)
        self._publisher = publisher
        self._asked = self._matching = False
        listener = zenoh.handlers.Callback(
            self._on_matching_status, indirect=False
        )  # no thread for each
        publisher.declare_matching_listener(listener)

    def _on_matching_status(self, status: "zenoh.MatchingStatus") -> None:
        self._asked = False

    @property
    def matching(self) -> bool:
        if not self.open:
            return False
        if not self._asked:
            self._asked = True  # first, for it may change meanwhile
            status: Any = self._publisher.matching_status  # the stubs call it a bool
            self._matching = bool(status.matching)
        return self._matching

    def put(self, payload: bytes) -> None:
        if self.open:
            self._publisher.put(payload)


class PeerLink(NamedTuple):
    """The link of a session to another one."""

    session: str
    peer: str  # the other side's address and port
    member: str = ""  # what its certificate says, such as `robot/r1`; empty without one

    @staticmethod
    def of(link: "zenoh.Link") -> "PeerLink":
        peer = re.split("[?#]", str(link.dst).partition("/")[2])[0]
        return PeerLink(str(link.zid), peer, link.auth_identifier or "")


class ZenohBus(Bus):
    """One Zenoh session."""

    def __init__(self, session: "zenoh.Session") -> None:
        self._session = session
        self.declared: dict[Declared, None] = {}

    def publisher(self, key: str, qos: Qos) -> Publisher:
        priority, when_full, reliable = qos.value
        kind = zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT
        publisher = self._session.declare_publisher(
            key,
            encoding=zenoh.Encoding.APPLICATION_JSON if is_json_key(key) else None,
            allowed_destination=zenoh.Locality.REMOTE,
            priority=getattr(zenoh.Priority, priority),
            congestion_control=getattr(zenoh.CongestionControl, when_full),
            reliability=kind,
        )
        return _ZenohPublisher(self, publisher)

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        def on_sample(sample: "zenoh.Sample") -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                on_message(str(sample.key_expr), sample.payload.to_bytes())

        return Declared(self.declared, self._session.declare_subscriber(keys, on_sample).undeclare)

    def declare_token(self, key: str) -> Handle:
        return Declared(self.declared, self._session.liveliness().declare_token(key).undeclare)

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        def on_sample(sample: "zenoh.Sample") -> None:
            on_change(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        liveliness = self._session.liveliness()
        subscriber = liveliness.declare_subscriber(keys, on_sample, history=True)
        return Declared(self.declared, subscriber.undeclare)

    def tokens(self, keys: str) -> list[str]:
        """The liveliness tokens that are there now."""
        replies = self._session.liveliness().get(keys, timeout=TOKENS_S)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def neighbours(self) -> dict[str, str]:
        """Who is linked to this session at present: its id -> what it is and where."""
        links = {str(link.zid): link.dst for link in self._session.info.links()}
        return {
            zid: f"{transport.whatami} at {links[zid]}"
            for transport in self._session.info.transports()
            if (zid := str(transport.zid)) in links
        }

    def links(self) -> list[PeerLink]:
        """The links of this session at present."""
        return [PeerLink.of(link) for link in self._session.info.links()]

    def watch_links(self, on_change: Callable[[], None]) -> Handle:
        """Calls `on_change` when a link was opened or has ended."""

        def on_event(event: "zenoh.LinkEvent") -> None:
            on_change()

        declared = self._session.info.declare_link_events_listener(on_event)
        return Declared(self.declared, declared.undeclare)

    def close(self) -> None:
        self.declared.clear()
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]
