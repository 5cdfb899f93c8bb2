"""What is to be done to a key folder: who is new, who stays, who gets another certificate."""

import re
from collections.abc import Collection, Iterator, Sequence
from enum import StrEnum
from typing import NamedTuple

import msgspec

from cpcbl_team.errors import InputError
from cpcbl_team.config import Team
from cpcbl_team.inputs import NAME_PATTERN
from cpcbl_transport.security import Identity, Member
from cpcbl_transport.topics import Role

ALL, AUTHORITY = "all", "ca"
SELF_NAMED = ("localhost", "127.0.0.1", "::1", "router")


class Deed(StrEnum):
    """What is done to one member."""

    MADE = "made"
    KEPT = "kept"
    RENEWED = "renewed"
    REVOKED = "revoked"


class Step(NamedTuple):
    """One member, and what is done to it."""

    member: Member
    deed: Deed


def plan(
    team: Team,
    known: Sequence[Member],
    observers: Collection[str] = (),
    renew: Collection[str] = (),
    revoke: Collection[str] = (),
) -> tuple[Step, ...]:
    """A step for each member that the team needs, is told to have, or had before.

    Raises InputError for names that nobody has.
    """
    for name in observers:
        if not re.fullmatch(NAME_PATTERN, name):
            raise InputError(
                f"--observer {name}: a name has 1 to 32 letters, digits, _, . or -; rename it"
            )
        if name in team.robots:
            raise InputError(f"--observer {name}: is a robot of the team; name it otherwise")
    for member in known:
        gone = member.revoked or str(member.identity) in revoke
        if member.role is Role.OBSERVER and not gone and member.name in team.robots:
            raise InputError(
                f"robots.{member.name}: an observer has this name; name the robot otherwise, or"
                f" --revoke {member.identity}"
            )
    before = {member.identity: member for member in known}
    wanted = [*_needed(team), *(Identity(Role.OBSERVER, name) for name in observers)]
    everyone = list(dict.fromkeys([*wanted, *before]))
    for option, names in (("--renew", {*renew} - {ALL, AUTHORITY}), ("--revoke", revoke)):
        for name in names:
            if not any(_called(identity, name) for identity in everyone):
                raise InputError(f"{option} {name}: nobody has this name; {_names(everyone)}")
    return tuple(_step(identity, before.get(identity), renew, revoke) for identity in everyone)


def hosts(team: Team, named: Collection[str]) -> tuple[str, ...]:
    """Where the team's router is dialled: by itself, by the team file, and as told."""
    endpoints = (*team.transport.connect, *team.transport.listen)
    dialled = [e.partition("/")[2].rpartition(":")[0].strip("[]") for e in endpoints]
    everywhere = ("0.0.0.0", "::")
    return tuple(dict.fromkeys(h for h in (*SELF_NAMED, *dialled, *named) if h not in everywhere))


def _needed(team: Team) -> Iterator[Identity]:
    yield Identity(Role.ROUTER)
    yield Identity(Role.OPERATOR)
    if team.simulated:
        yield Identity(Role.FIELD)
    for name in team.robots:
        yield Identity(Role.ROBOT, name)


def _step(
    identity: Identity, before: Member | None, renew: Collection[str], revoke: Collection[str]
) -> Step:
    if before is None:
        return Step(Member(role=identity.role, name=identity.name), Deed.MADE)
    if any(_called(identity, name) for name in revoke):
        return Step(msgspec.structs.replace(before, revoked=True), Deed.REVOKED)
    by_name = any(_called(identity, name) for name in renew)
    if by_name and before.revoked:
        again = msgspec.structs.replace(before, revoked=False, generation=before.generation + 1)
        return Step(again, Deed.MADE)
    if by_name or (ALL in renew and not before.revoked):
        return Step(before, Deed.RENEWED)
    return Step(before, Deed.REVOKED if before.revoked else Deed.KEPT)


def _called(identity: Identity, name: str) -> bool:
    """`r1`, or `robot/r1` where a name alone would not do."""
    return name in (str(identity), identity.name or str(identity.role))


def _names(identities: Collection[Identity]) -> str:
    return f"there are: {', '.join(map(str, identities))}"
