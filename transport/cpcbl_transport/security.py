"""Mutual TLS and access control: which keys a session uses, and what each member may publish.

Both are Zenoh's own, as its configuration. What was measured:

- The common name of a certificate is the one thing that access control knows of its owner; it is
  compared as it is, without patterns.
- Keys in rules are whole keys, with the namespace.
- What is denied is dropped silently: the sender is not told, and its `matching` stays true.
- A key file is read when a link is opened, so a renewed one counts from the next link on. The
  router's own files, and the rules, are read when it starts.
- There are no lists of revoked certificates. A former member can open a link until its certificate
  expires, but the link carries nothing. Links do not outlive their certificates.
"""

import logging
import os
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from cpcbl_team.config import Team
from cpcbl_team.errors import CpcblError
from cpcbl_transport import topics
from cpcbl_transport.topics import Permission, Role, Topic

log = logging.getLogger(__name__)

CA, CERTIFICATE, PRIVATE_KEY, MEMBERS = "ca.crt", "certificate.crt", "private.key", "members.json"
PROTOCOL = "tls"
"""Not QUIC, which certifies names as well, but sometimes loses the first message of a new key."""


class SecurityError(CpcblError):
    """Keys or endpoints that cannot be used; the text names file or key, and the fix."""


class Identity(NamedTuple):
    """Who a session belongs to. Robots and observers have names; each other role has one member."""

    role: Role
    name: str = ""

    def __str__(self) -> str:
        """`robot/r1`, `field`: also the folder of its keys."""
        return f"{self.role}/{self.name}" if self.name else str(self.role)


class Member(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the list from which the router's rules are made."""

    role: Role
    name: str = ""
    generation: int = 1
    """One more for every certificate that was revoked: its name is never used again."""
    revoked: bool = False

    @property
    def identity(self) -> Identity:
        return Identity(self.role, self.name)

    @property
    def common_name(self) -> str:
        """What its certificate says: `robot/r1`, `robot/r1/2`. No name has a slash in it."""
        later = f"/{self.generation}" if self.generation > 1 else ""
        return f"{self.identity}{later}"


class Credentials(NamedTuple):
    """Key files of one session."""

    ca: str  # certificates of the authorities that are trusted
    certificate: str
    private_key: str


class Link(NamedTuple):
    """Where a session dials or listens, and the keys that it uses there."""

    endpoints: tuple[str, ...]
    credentials: Credentials | None = None


def link_of(team: Team, identity: Identity, endpoints: Collection[str]) -> Link:
    """The link of a member of a team. Raises SecurityError for what a secured team cannot use."""
    if not team.transport.secured:
        return Link(tuple(endpoints))
    for endpoint in endpoints:
        if not endpoint.startswith(f"{PROTOCOL}/"):
            raise SecurityError(
                f'{endpoint}: with transport.security = "mtls" every link is TLS; write it as'
                f" {PROTOCOL}/{endpoint.partition('/')[2]}"
            )
    return Link(tuple(endpoints), credentials_in(Path(team.transport.keys), identity))


def credentials_in(folder: Path, identity: Identity) -> Credentials:
    """The key files of a member in the team's key folder. Raises SecurityError if one is absent.
    A private key that others can read is used, and that is said once."""
    paths = [folder / str(identity) / name for name in (CA, CERTIFICATE, PRIVATE_KEY)]
    for path in paths:
        try:
            path.open("rb").close()
        except OSError as error:
            raise SecurityError(
                f"transport.keys: {path}: {error.strerror}; `cpcbl-team keys FILE` makes the keys"
                f" of {identity}, which this process must be able to read"
            ) from error
    _warn_if_open(folder / str(identity) / PRIVATE_KEY)
    return Credentials(*map(str, paths))


@cache
def _warn_if_open(private_key: Path) -> None:
    """Says that others on this machine can read or change a private key. Not on a file system that
    is mounted read-only: that is a secret of a container, which has no other users."""
    others = private_key.stat().st_mode & 0o026
    if others and not os.statvfs(private_key).f_flag & os.ST_RDONLY:
        verb = "change" if others & 0o022 else "read"
        log.warning(
            "transport.keys: %s: others on this machine can %s this private key; run"
            " `chmod 600 %s`, and renew the key if they may have used it",
            *(private_key, verb, private_key),
        )


def members_in(folder: Path) -> tuple[Member, ...]:
    """Who is known in a key folder. Raises SecurityError for a list that cannot be read."""
    path = folder / str(Role.ROUTER) / MEMBERS
    try:
        return msgspec.json.decode(path.read_bytes(), type=tuple[Member, ...])
    except (OSError, msgspec.MsgspecError) as error:
        why = error.strerror if isinstance(error, OSError) else error
    raise SecurityError(f"transport.keys: {path}: {why}; `cpcbl-team keys FILE` writes it")


def access_control(team: Team) -> dict[str, Any]:
    """What a router of this team adds to its guards; nothing for a team that is not secured. Raises
    SecurityError without the list of members."""
    secured, folder = team.transport.secured, Path(team.transport.keys)
    return access_rules(team, members_in(folder)) if secured else {}


def link_options(credentials: Credentials) -> dict[str, Any]:
    """What stands below `transport/link` where every link is mutual TLS."""
    ca, certificate, private_key = credentials
    return {
        "protocols": [PROTOCOL],
        "tls": {
            "enable_mtls": True,
            "root_ca_certificate": ca,
            "connect_certificate": certificate,
            "connect_private_key": private_key,
            "listen_certificate": certificate,
            "listen_private_key": private_key,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


_SUBSCRIBING = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
_DELIVERED = ("put", "declare_subscriber", "liveliness_token")
_ALL_MESSAGES = (
    *("put", "delete", "query", "reply", "declare_queryable"),
    *("declare_subscriber", "declare_liveliness_subscriber"),
    *("liveliness_token", "liveliness_query"),
)


def access_rules(team: Team, members: Iterable[Member]) -> dict[str, Any]:
    """The router's access control: nobody may publish or receive more than the table allows.

    Whoever is not among the members, was revoked, or has no place in the present team file can
    neither publish nor receive anything.
    """
    space = topics.namespace(team.name)
    present = [m for m in members if not m.revoked and _is_in_team(m.identity, team)]
    routers = [m for m in present if m.role is Role.ROUTER]
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []

    def allow(
        name: str, who: list[Member], flow: str, messages: Sequence[str], keys: Sequence[str]
    ) -> None:
        if who and keys:
            whole = [f"{space}/{key}" for key in keys]
            rule = {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages)}
            rules.append({**rule, "key_exprs": whole})
            subjects.append({"id": name, "cert_common_names": [m.common_name for m in who]})

    allow("deliver", present, "egress", _DELIVERED, ["**"])
    for member in present:
        who = member.identity
        for messages, keys in (
            (("put",), publish_keys(who, carrying=True)),
            (("liveliness_token",), publish_keys(who, carrying=False)),
            (_SUBSCRIBING, subscribe_keys(who)),
        ):
            allow(f"{who}: {messages[0]}", [member], "ingress", messages, keys)
    for flow in ("ingress", "egress"):
        allow(f"relay: {flow}", routers, flow, _ALL_MESSAGES, ["**"])
    policies = [{"rules": [rule["id"]], "subjects": [rule["id"]]} for rule in rules]
    control = {"enabled": True, "default_permission": "deny", "rules": rules}
    return {"access_control": {**control, "subjects": subjects, "policies": policies}}


def publish_keys(identity: Identity, carrying: bool) -> list[str]:
    """The keys of messages (`carrying`), or of tokens, that a member may publish."""
    return [
        key
        for topic in topics.TOPICS
        if carrying is (topic.carries is not None)
        for key in _keys(topic, topic.publishers, identity)
    ]


def subscribe_keys(identity: Identity) -> list[str]:
    """The keys that a member may subscribe to, with all that they include."""
    if identity.role is Role.OPERATOR:
        return ["**"]
    return [key for topic in topics.TOPICS for key in _keys(topic, topic.subscribers, identity)]


def _keys(topic: Topic, allowed: Iterable[Permission], identity: Identity) -> Iterator[str]:
    for who in allowed:
        if who.role is identity.role:
            yield from topic.keys(**{who.own: identity.name} if who.own else {})


def _is_in_team(identity: Identity, team: Team) -> bool:
    """Whether the present team file still has a place for a member."""
    match identity.role:
        case Role.ROBOT:
            return identity.name in team.robots
        case Role.OBSERVER:
            return team.guests.allowed and identity.name not in team.robots
        case Role.FIELD:  # a simulated one must not feed real robots
            return team.simulated
        case Role.GATEWAY:
            return team.gateway is not None
        case Role.BRIDGE:
            return team.ros2 is not None
    return True
