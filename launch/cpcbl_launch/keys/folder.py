"""A key folder: one folder a member with all that its machine needs, and that of the authority.

    keys/ca                      private.key, ca.crt: only where certificates are made
    keys/router                  ca.crt, certificate.crt, private.key, members.json
    keys/robot/r1                ca.crt, certificate.crt, private.key
    keys/observer/…, field, gateway, operator

Folders are 0700 and private keys 0600 from the first byte on. A file is replaced as a whole. A
`.gitignore` keeps all of it out of a repository.
"""

import os
import re
import secrets
from collections.abc import Collection, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

import msgspec

from cpcbl_launch.keys.authority import (
    KeyPair,
    certificate_facts,
    is_matching_pair,
    is_signed_by,
    issue_certificate,
    new_authority,
    newest_certificate,
)
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import NAME_PATTERN
from cpcbl_transport.security import (
    CA,
    CERTIFICATE,
    MEMBERS,
    PRIVATE_KEY,
    Identity,
    Member,
    members_in,
)
from cpcbl_transport.topics import Role

ALL, AUTHORITY = "all", "ca"
SELF_NAMED = ("localhost", "127.0.0.1", "::1", "router")
SECRET, PUBLIC = 0o600, 0o644
DIALLED = (Role.ROUTER, Role.GATEWAY)  # their certificates name hosts
KeyAction = Literal["made", "kept", "renewed", "revoked"]
"""What is done to one member."""


class KeysReport(msgspec.Struct, frozen=True):
    """One row of what `keys` says."""

    who: str
    common_name: str
    deed: KeyAction
    valid_until: datetime | None = None
    hosts: tuple[str, ...] = ()


class KeyRequest(msgspec.Struct, frozen=True):
    """What `keys` is asked for."""

    observers: Sequence[str] = ()
    hosts: Sequence[str] = ()
    lasting: timedelta = timedelta(days=365)
    renew: Sequence[str] = ()
    revoke: Sequence[str] = ()
    retire_ca: bool = False


def make_keys(team: Team, folder: Path, request: KeyRequest) -> list[KeysReport]:
    """Makes what is missing in a key folder, and renews what the request names.

    Raises InputError for a request that cannot be met, OSError where nothing can be written.
    """
    now = datetime.now(UTC)
    router = folder / str(Role.ROUTER)
    plan = plan_actions(team, members_in(folder) if (router / MEMBERS).exists() else (), request)
    for member, action in plan.items():
        if action == "kept" and not _has_key(folder / str(member.identity)):
            plan[member] = "made"
    kept = any(m.role is Role.ROUTER and action == "kept" for m, action in plan.items())
    reached = _reached_hosts(team, router / CERTIFICATE, request.hosts, kept)
    _make_folder(folder)
    _replace_file(folder / ".gitignore", b"*\n", PUBLIC)
    authorities, action_of_authority = _authorities(team, folder, request, now)
    for member, action in plan.items():
        if action in ("made", "renewed"):
            pair = issue_certificate(
                _signing_pair(folder, authorities),
                member.common_name,
                reached if member.role in DIALLED else (),
                now,
                request.lasting,
            )
            at = folder / str(member.identity)
            _make_folder(at)
            _replace_file(at / PRIVATE_KEY, pair.private_key, SECRET)
            _replace_file(at / CERTIFICATE, pair.certificate, PUBLIC)
    present = [folder / str(m.identity) for m, action in plan.items() if action != "revoked"]
    if request.retire_ca:
        authorities = _retire_old_authorities(present, folder, authorities)
    for at in present:
        _replace_file(at / CA, authorities, PUBLIC)
    members = msgspec.json.format(msgspec.json.encode(list(plan)), indent=1)
    _replace_file(router / MEMBERS, members, PUBLIC)
    facts = certificate_facts(newest_certificate(authorities))
    authority = KeysReport(AUTHORITY, facts.common_name, action_of_authority, facts.not_after)
    return [authority, *(_report(member, action, folder) for member, action in plan.items())]


def plan_actions(
    team: Team, known: Sequence[Member], request: KeyRequest
) -> dict[Member, KeyAction]:
    """What is done to each member that the team needs, is asked to have, or had before.

    Raises InputError for names that nobody has.
    """
    for name in request.observers:
        if not re.fullmatch(NAME_PATTERN, name):
            raise InputError(
                f"--observer {name}: a name has 1 to 32 letters, digits, _, . or -; rename it"
            )
        if name in team.robots:
            raise InputError(f"--observer {name}: is a robot of the team; name it otherwise")
    for member in known:
        gone = member.revoked or str(member.identity) in request.revoke
        if member.role is Role.OBSERVER and not gone and member.name in team.robots:
            raise InputError(
                f"robots.{member.name}: an observer has this name; name the robot otherwise, or"
                f" --revoke {member.identity}"
            )
    before = {member.identity: member for member in known}
    wanted = [Identity(role) for role in (Role.ROUTER, Role.OPERATOR)]
    wanted += [Identity(Role.FIELD)] if team.simulated else []
    wanted += [Identity(Role.GATEWAY)] if team.gateway else []
    wanted += [Identity(Role.BRIDGE)] if team.ros2 else []
    wanted += [Identity(Role.ROBOT, name) for name in team.robots]
    wanted += [Identity(Role.OBSERVER, name) for name in request.observers]
    everyone = list(dict.fromkeys([*wanted, *before]))
    renewed = {*request.renew} - {ALL, AUTHORITY}
    for option, names in (("--renew", renewed), ("--revoke", request.revoke)):
        for name in names:
            if not any(_is_named(identity, (name,)) for identity in everyone):
                there = ", ".join(map(str, everyone))
                raise InputError(f"{option} {name}: nobody has this name; there are: {there}")
    return dict(
        _member_action(before[identity], request)
        if identity in before
        else (Member(role=identity.role, name=identity.name), "made")
        for identity in everyone
    )


def _member_action(before: Member, request: KeyRequest) -> tuple[Member, KeyAction]:
    """A member that was there before, as it is from now on, and what is done to it."""
    if _is_named(before.identity, request.revoke):
        return msgspec.structs.replace(before, revoked=True), "revoked"
    by_name = _is_named(before.identity, request.renew)
    if before.revoked and by_name:
        again = before.generation + 1
        return msgspec.structs.replace(before, revoked=False, generation=again), "made"
    if before.revoked:
        return before, "revoked"
    return before, "renewed" if by_name or ALL in request.renew else "kept"


def _is_named(identity: Identity, names: Collection[str]) -> bool:
    """Whether it is among these: `r1`, or `robot/r1` where a name alone would not do."""
    return str(identity) in names or (identity.name or str(identity.role)) in names


def hosts(team: Team, named: Iterable[str]) -> tuple[str, ...]:
    """The hosts at which the router is reached: its own, those of the team file, and `named`."""
    endpoints = (*team.transport.connect, *team.transport.listen)
    dialled = [e.partition("/")[2].rpartition(":")[0].strip("[]") for e in endpoints]
    everywhere = ("0.0.0.0", "::")
    return tuple(dict.fromkeys(h for h in (*SELF_NAMED, *dialled, *named) if h not in everywhere))


def _reached_hosts(
    team: Team, certificate: Path, named: Sequence[str], kept: bool
) -> tuple[str, ...]:
    """The hosts of the router's certificate, and those of the next one.

    A router that keeps its certificate cannot be dialled at another host. Raises InputError.
    """
    before = certificate_facts(certificate.read_bytes()).hosts if certificate.exists() else ()
    lacking = [host for host in named if host not in before]
    if kept and lacking:
        raise InputError(
            f"--host {lacking[0]}: not in the router's certificate, which has"
            f" {', '.join(before)}; add --renew router"
        )
    return tuple(dict.fromkeys((*before, *hosts(team, named))))


def _has_key(at: Path) -> bool:
    try:
        pair = KeyPair((at / PRIVATE_KEY).read_bytes(), (at / CERTIFICATE).read_bytes())
    except FileNotFoundError:
        return False
    return is_matching_pair(pair)


def _authorities(
    team: Team, folder: Path, request: KeyRequest, now: datetime
) -> tuple[bytes, KeyAction]:
    """The certificates of all authorities that are trusted, that in use first; what was done."""
    at = folder / AUTHORITY
    trusted = (at / CA).read_bytes() if (at / CA).exists() else b""
    if trusted and AUTHORITY not in request.renew:
        return trusted, "kept"
    _make_folder(at)
    authority = new_authority(team.name, now)
    # The certificate first: a key without it could sign what nobody trusts.
    _replace_file(at / CA, authority.certificate + trusted, PUBLIC)
    _replace_file(at / PRIVATE_KEY, authority.private_key, SECRET)
    return authority.certificate + trusted, "renewed" if trusted else "made"


def _signing_pair(folder: Path, authorities: bytes) -> KeyPair:
    path = folder / AUTHORITY / PRIVATE_KEY
    try:
        return KeyPair(path.read_bytes(), newest_certificate(authorities))
    except FileNotFoundError:
        raise InputError(
            f"{path}: the authority's key is not here; bring it back from where it is kept, or make"
            " a new authority with --renew ca"
        ) from None


def _retire_old_authorities(present: Iterable[Path], folder: Path, authorities: bytes) -> bytes:
    """Trusts the newest authority alone. `present`: the folders of all members."""
    latest = newest_certificate(authorities)
    for at in present:
        if not is_signed_by((at / CERTIFICATE).read_bytes(), latest):
            raise InputError(
                f"--retire-ca: {at.relative_to(folder)} still has a certificate of the old"
                " authority; --renew all first, and bring the new ones to their machines"
            )
    _replace_file(folder / AUTHORITY / CA, latest, PUBLIC)
    return latest


def _report(member: Member, action: KeyAction, folder: Path) -> KeysReport:
    path = folder / str(member.identity) / CERTIFICATE
    facts = certificate_facts(path.read_bytes()) if path.exists() else None
    certified = (facts.not_after, facts.hosts) if facts else ()
    return KeysReport(str(member.identity), member.common_name, action, *certified)


def _make_folder(path: Path) -> None:
    missing = [p for p in (path, *path.parents) if not p.exists()]
    for each in reversed(missing):
        each.mkdir(mode=0o700)


def _replace_file(path: Path, content: bytes, mode: int) -> None:
    """Replaces a file as a whole; nobody else can ever read what is secret."""
    if path.exists() and path.read_bytes() == content:
        return
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
