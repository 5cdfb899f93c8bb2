"""What is to be done to a key folder: who is new, who stays, who gets another certificate."""

import re
from collections.abc import Collection, Iterator, Sequence
from enum import StrEnum
from typing import NamedTuple

import msgspec

from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import NAME_PATTERN
from cpcbl_transport.security import Identity, Member
from cpcbl_transport.topics import Role

ALL, AUTHORITY = "all", "ca"
SELF_NAMED = ("localhost", "127.0.0.1", "::1", "router")


class KeyAction(StrEnum):
    """What is done to one member."""

    MADE = "made"
    KEPT = "kept"
    RENEWED = "renewed"
    REVOKED = "revoked"


class MemberAction(NamedTuple):
    """One member, and what is done to it."""

    member: Member
    action: KeyAction


def plan_actions(
    team: Team,
    known: Sequence[Member],
    observers: Collection[str] = (),
    renew: Collection[str] = (),
    revoke: Collection[str] = (),
) -> tuple[MemberAction, ...]:
    """A step for each member that the team needs, is asked to have, or had before.

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
    wanted = [*_required_identities(team), *(Identity(Role.OBSERVER, name) for name in observers)]
    everyone = list(dict.fromkeys([*wanted, *before]))
    for option, names in (("--renew", {*renew} - {ALL, AUTHORITY}), ("--revoke", revoke)):
        for name in names:
            if not any(_is_named(identity, name) for identity in everyone):
                raise InputError(f"{option} {name}: nobody has this name; {_names(everyone)}")
    return tuple(
        _member_action(identity, before.get(identity), renew, revoke) for identity in everyone
    )


def hosts(team: Team, named: Collection[str]) -> tuple[str, ...]:
    """The hosts at which the router is reached: its own, those of the team file, and `named`."""
    endpoints = (*team.transport.connect, *team.transport.listen)
    dialled = [e.partition("/")[2].rpartition(":")[0].strip("[]") for e in endpoints]
    everywhere = ("0.0.0.0", "::")
    return tuple(dict.fromkeys(h for h in (*SELF_NAMED, *dialled, *named) if h not in everywhere))


def _required_identities(team: Team) -> Iterator[Identity]:
    yield Identity(Role.ROUTER)
    yield Identity(Role.OPERATOR)
    if team.simulated:
        yield Identity(Role.FIELD)
    for name in team.robots:
        yield Identity(Role.ROBOT, name)


def _member_action(
    identity: Identity, before: Member | None, renew: Collection[str], revoke: Collection[str]
) -> MemberAction:
    if before is None:
        return MemberAction(Member(role=identity.role, name=identity.name), KeyAction.MADE)
    if any(_is_named(identity, name) for name in revoke):
        return MemberAction(msgspec.structs.replace(before, revoked=True), KeyAction.REVOKED)
    by_name = any(_is_named(identity, name) for name in renew)
    if by_name and before.revoked:
        again = msgspec.structs.replace(before, revoked=False, generation=before.generation + 1)
        return MemberAction(again, KeyAction.MADE)
    if by_name or (ALL in renew and not before.revoked):
        return MemberAction(before, KeyAction.RENEWED)
    return MemberAction(before, KeyAction.REVOKED if before.revoked else KeyAction.KEPT)


def _is_named(identity: Identity, name: str) -> bool:
    """`r1`, or `robot/r1` where a name alone would not do."""
    return name in (str(identity), identity.name or str(identity.role))


def _names(identities: Collection[Identity]) -> str:
    return f"there are: {', '.join(map(str, identities))}"
