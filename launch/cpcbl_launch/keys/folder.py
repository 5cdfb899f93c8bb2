"""A key folder: one folder a member with all that its machine needs, and that of the authority.

    keys/ca                      private.key, ca.crt: only where certificates are made
    keys/router                  ca.crt, certificate.crt, private.key, members.json
    keys/robot/r1                ca.crt, certificate.crt, private.key
    keys/observer/…, field, operator

Folders are 0700 and private keys 0600 from the first byte on. A file is replaced as a whole. A
`.gitignore` keeps all of it out of a repository.
"""

import os
import secrets
from collections.abc import Collection, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

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
from cpcbl_launch.keys.plan import AUTHORITY, KeyAction, MemberAction, hosts, plan_actions
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport.security import CA, CERTIFICATE, MEMBERS, PRIVATE_KEY, Identity, members_in
from cpcbl_transport.topics import Role

SECRET, PUBLIC = 0o600, 0o644


class KeysReport(msgspec.Struct, frozen=True, kw_only=True):
    """One row of what `keys` says."""

    who: str
    common_name: str
    deed: str
    valid_until: datetime | None
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
    known = members_in(folder) if (folder / str(Role.ROUTER) / MEMBERS).exists() else ()
    steps = plan_actions(team, known, request.observers, request.renew, request.revoke)
    steps = tuple(_with_missing_key(step, folder) for step in steps)
    reached = hosts(team, request.hosts)
    _check_hosts(steps, folder, request.hosts)
    _make_folder(folder)
    _replace_file(folder / ".gitignore", b"*\n", PUBLIC)
    before = (folder / AUTHORITY / CA).exists()
    authorities = _authorities(team, folder, request, now)
    for step in steps:
        at = folder / str(step.member.identity)
        if step.action in (KeyAction.MADE, KeyAction.RENEWED):
            names = _hosts_of(step.member.identity, at, reached)
            pair = issue_certificate(
                _signing_pair(folder, authorities),
                step.member.common_name,
                names,
                now,
                request.lasting,
            )
            _make_folder(at)
            _replace_file(at / PRIVATE_KEY, pair.private_key, SECRET)
            _replace_file(at / CERTIFICATE, pair.certificate, PUBLIC)
    if request.retire_ca:
        authorities = _retire_old_authorities(steps, folder, authorities)
    for step in steps:
        if step.action is not KeyAction.REVOKED:
            _replace_file(folder / str(step.member.identity) / CA, authorities, PUBLIC)
    members = msgspec.json.encode([step.member for step in steps])
    _replace_file(
        folder / str(Role.ROUTER) / MEMBERS, msgspec.json.format(members, indent=1), PUBLIC
    )
    action = (
        KeyAction.MADE
        if not before
        else KeyAction.RENEWED
        if AUTHORITY in request.renew
        else KeyAction.KEPT
    )
    facts = certificate_facts(newest_certificate(authorities))
    authority = KeysReport(
        who=AUTHORITY, common_name=facts.common_name, deed=action, valid_until=facts.not_after
    )
    return [authority, *(_report(step, folder) for step in steps)]


def _with_missing_key(step: MemberAction, folder: Path) -> MemberAction:
    """A member whose key is gone, or not that of its certificate, gets another."""
    at = folder / str(step.member.identity)
    try:
        whole = is_matching_pair(
            KeyPair((at / PRIVATE_KEY).read_bytes(), (at / CERTIFICATE).read_bytes())
        )
    except FileNotFoundError:
        whole = False
    return (
        step if whole or step.action is not KeyAction.KEPT else step._replace(action=KeyAction.MADE)
    )


def _check_hosts(steps: Iterable[MemberAction], folder: Path, named: Collection[str]) -> None:
    """A router that keeps its certificate cannot be dialled at another host."""
    for step in steps:
        if step.member.role is Role.ROUTER and step.action is KeyAction.KEPT:
            has = certificate_facts((folder / str(Role.ROUTER) / CERTIFICATE).read_bytes()).hosts
            lacking = [host for host in named if host not in has]
            if lacking:
                raise InputError(
                    f"--host {lacking[0]}: not in the router's certificate, which has"
                    f" {', '.join(has)}; add --renew router"
                )


def _hosts_of(identity: Identity, at: Path, reached: tuple[str, ...]) -> tuple[str, ...]:
    """Only routers are dialled; a renewed one wherever it was before."""
    if identity.role is not Role.ROUTER:
        return ()
    old = at / CERTIFICATE
    before = certificate_facts(old.read_bytes()).hosts if old.exists() else ()
    return tuple(dict.fromkeys((*before, *reached)))


def _authorities(team: Team, folder: Path, request: KeyRequest, now: datetime) -> bytes:
    """The certificates of all authorities that are trusted, that in use first."""
    at = folder / AUTHORITY
    trusted = (at / CA).read_bytes() if (at / CA).exists() else b""
    if trusted and AUTHORITY not in request.renew:
        return trusted
    _make_folder(at)
    authority = new_authority(team.name, now)
    # The certificate first: a key without it could sign what nobody trusts.
    _replace_file(at / CA, authority.certificate + trusted, PUBLIC)
    _replace_file(at / PRIVATE_KEY, authority.private_key, SECRET)
    return authority.certificate + trusted


def _signing_pair(folder: Path, authorities: bytes) -> KeyPair:
    path = folder / AUTHORITY / PRIVATE_KEY
    try:
        return KeyPair(path.read_bytes(), newest_certificate(authorities))
    except FileNotFoundError:
        raise InputError(
            f"{path}: the authority's key is not here; bring it back from where it is kept, or make"
            " a new authority with --renew ca"
        ) from None


def _retire_old_authorities(
    steps: Iterable[MemberAction], folder: Path, authorities: bytes
) -> bytes:
    """Trusts the newest authority alone."""
    latest = newest_certificate(authorities)
    for step in steps:
        certificate = folder / str(step.member.identity) / CERTIFICATE
        if step.action is not KeyAction.REVOKED and not is_signed_by(
            certificate.read_bytes(), latest
        ):
            raise InputError(
                f"--retire-ca: {step.member.identity} still has a certificate of the old authority;"
                " --renew all first, and bring the new ones to their machines"
            )
    _replace_file(folder / AUTHORITY / CA, latest, PUBLIC)
    return latest


def _report(step: MemberAction, folder: Path) -> KeysReport:
    path = folder / str(step.member.identity) / CERTIFICATE
    facts = certificate_facts(path.read_bytes()) if path.exists() else None
    return KeysReport(
        who=str(step.member.identity),
        common_name=step.member.common_name,
        deed=step.action,
        valid_until=facts.not_after if facts else None,
        hosts=facts.hosts if facts else (),
    )


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
