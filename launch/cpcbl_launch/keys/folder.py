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
from collections.abc import Collection, Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec

from cpcbl_team.errors import InputError
from cpcbl_launch.keys.authority import (
    Pair,
    belong_together,
    facts,
    issued,
    new_authority,
    newest,
    signed_by,
)
from cpcbl_launch.keys.plan import AUTHORITY, Deed, Step, hosts, plan
from cpcbl_team.config import Team
from cpcbl_transport.security import (
    CA,
    CERTIFICATE,
    MEMBERS,
    PRIVATE_KEY,
    Identity,
    members_in,
)
from cpcbl_transport.topics import Role

SECRET, PUBLIC = 0o600, 0o644


class KeysReport(msgspec.Struct, frozen=True, kw_only=True):
    """One row of what `keys` says."""

    who: str
    common_name: str
    deed: str
    valid_until: datetime | None
    hosts: tuple[str, ...] = ()


class Wish(msgspec.Struct, frozen=True, kw_only=True):
    """What `keys` is asked for."""

    observers: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()
    lasting: timedelta = timedelta(days=365)
    renew: tuple[str, ...] = ()
    revoke: tuple[str, ...] = ()
    retire_ca: bool = False


def make_keys(team: Team, folder: Path, wish: Wish) -> list[KeysReport]:
    """Makes what is missing in a key folder, and what the wish names anew.

    Raises InputError for a wish that cannot be met, OSError where nothing can be written.
    """
    now = datetime.now(UTC)
    known = members_in(folder) if (folder / str(Role.ROUTER) / MEMBERS).exists() else ()
    steps = plan(team, known, wish.observers, wish.renew, wish.revoke)
    steps = tuple(_missing(step, folder) for step in steps)
    reached = hosts(team, wish.hosts)
    _check_hosts(steps, folder, wish.hosts)
    _folder(folder)
    _write(folder / ".gitignore", b"*\n", PUBLIC)
    before = (folder / AUTHORITY / CA).exists()
    authorities = _authorities(team, folder, wish, now)
    for step in steps:
        at = folder / str(step.member.identity)
        if step.deed in (Deed.MADE, Deed.RENEWED):
            names = _hosts_of(step.member.identity, at, reached)
            pair = issued(
                _signer(folder, authorities), step.member.common_name, names, now, wish.lasting
            )
            _folder(at)
            _write(at / PRIVATE_KEY, pair.private_key, SECRET)
            _write(at / CERTIFICATE, pair.certificate, PUBLIC)
    if wish.retire_ca:
        authorities = _retired(steps, folder, authorities)
    for step in steps:
        if step.deed is not Deed.REVOKED:
            _write(folder / str(step.member.identity) / CA, authorities, PUBLIC)
    members = msgspec.json.encode([step.member for step in steps])
    _write(folder / str(Role.ROUTER) / MEMBERS, msgspec.json.format(members, indent=1), PUBLIC)
    deed = Deed.MADE if not before else Deed.RENEWED if AUTHORITY in wish.renew else Deed.KEPT
    said = facts(newest(authorities))
    authority = KeysReport(
        who=AUTHORITY, common_name=said.common_name, deed=deed, valid_until=said.not_after
    )
    return [authority, *(_report(step, folder) for step in steps)]


def _missing(step: Step, folder: Path) -> Step:
    """A member whose key is gone, or not that of its certificate, gets another."""
    at = folder / str(step.member.identity)
    try:
        whole = belong_together(
            Pair((at / PRIVATE_KEY).read_bytes(), (at / CERTIFICATE).read_bytes())
        )
    except FileNotFoundError:
        whole = False
    return step if whole or step.deed is not Deed.KEPT else step._replace(deed=Deed.MADE)


def _check_hosts(steps: Iterable[Step], folder: Path, named: Collection[str]) -> None:
    """A router that keeps its certificate cannot be dialled at another host."""
    for step in steps:
        if step.member.role is Role.ROUTER and step.deed is Deed.KEPT:
            has = facts((folder / str(Role.ROUTER) / CERTIFICATE).read_bytes()).hosts
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
    before = facts(old.read_bytes()).hosts if old.exists() else ()
    return tuple(dict.fromkeys((*before, *reached)))


def _authorities(team: Team, folder: Path, wish: Wish, now: datetime) -> bytes:
    """The certificates of all authorities that are trusted, that in use first."""
    at = folder / AUTHORITY
    trusted = (at / CA).read_bytes() if (at / CA).exists() else b""
    if trusted and AUTHORITY not in wish.renew:
        return trusted
    _folder(at)
    authority = new_authority(team.name, now)
    # The certificate first: a key without it could sign what nobody trusts.
    _write(at / CA, authority.certificate + trusted, PUBLIC)
    _write(at / PRIVATE_KEY, authority.private_key, SECRET)
    return authority.certificate + trusted


def _signer(folder: Path, authorities: bytes) -> Pair:
    path = folder / AUTHORITY / PRIVATE_KEY
    try:
        return Pair(path.read_bytes(), newest(authorities))
    except FileNotFoundError:
        raise InputError(
            f"{path}: the authority's key is not here; bring it back from where it is kept, or make"
            " a new authority with --renew ca"
        ) from None


def _retired(steps: Iterable[Step], folder: Path, authorities: bytes) -> bytes:
    """Trusts the newest authority alone."""
    latest = newest(authorities)
    for step in steps:
        certificate = folder / str(step.member.identity) / CERTIFICATE
        if step.deed is not Deed.REVOKED and not signed_by(certificate.read_bytes(), latest):
            raise InputError(
                f"--retire-ca: {step.member.identity} still has a certificate of the old authority;"
                " --renew all first, and bring the new ones to their machines"
            )
    _write(folder / AUTHORITY / CA, latest, PUBLIC)
    return latest


def _report(step: Step, folder: Path) -> KeysReport:
    path = folder / str(step.member.identity) / CERTIFICATE
    said = facts(path.read_bytes()) if path.exists() else None
    return KeysReport(
        who=str(step.member.identity),
        common_name=step.member.common_name,
        deed=step.deed,
        valid_until=said.not_after if said else None,
        hosts=said.hosts if said else (),
    )


def _folder(path: Path) -> None:
    missing = [p for p in (path, *path.parents) if not p.exists()]
    for each in reversed(missing):
        each.mkdir(mode=0o700)


def _write(path: Path, content: bytes, mode: int) -> None:
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
