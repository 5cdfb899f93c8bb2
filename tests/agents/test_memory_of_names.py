"""A robot that ever new guests help and are helped by does not remember all of them."""

import gc
from types import FunctionType, ModuleType

import msgspec
import pytest
from support.buses import SECOND, TeamOnBus, robot_at, saw, team_of

from cpcbl_agents import clocks, message_counters
from cpcbl_agents.input_diagnosis import monitor
from cpcbl_team import state, teammates
from cpcbl_team.config import GuestSettings
from cpcbl_team.inputs import Fix, Sighting
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryBus, MemoryHub

GUESTS, FEW = 80, 10
OUTSIDE = type, ModuleType, FunctionType, MemoryHub, MemoryBus


def names_in(root: object) -> set[str]:
    """The names of guests in all that an object refers to."""
    seen, parts, names = set[int](), [root], set[str]()
    for part in parts:  # the list grows meanwhile
        if isinstance(part, str) and "ghost" in part:
            names.add(part[part.index("ghost") :].split("/")[0])
        if id(part) not in seen and not isinstance(part, OUTSIDE):
            seen.add(id(part))
            parts += gc.get_referents(part)
    return names


def test_names_of_guests_that_left_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, limit in (
        (clocks, "MOST_SENDERS"),
        (message_counters, "MOST_PEERS"),
        (teammates, "MOST_SENDERS"),
        (state, "MOST_OBJECTS"),
        (monitor, "STEPS"),  # so many frames are kept, too
    ):
        monkeypatch.setattr(module, limit, FEW, raising=False)
    team = msgspec.structs.replace(
        team_of(me=robot_at(sigma_m=0.3)), guests=GuestSettings(most=100)
    )
    stand = TeamOnBus(team)
    stand.stand_still(0.2)
    for number in range(GUESTS):
        visit(stand, f"ghost{number}", helps=number % 2 == 0)
    counts = stand.status("me").counts
    assert counts["guest_joined"] == counts["guest_left"] == GUESTS
    sent = stand.robots["me"].collaboration.counters.flows()
    heard = stand.nodes["me"].received.flows()
    for flows in (sent, heard):
        assert sum(f.messages for f in flows) >= GUESTS // 2  # they did help
        assert len(flows) <= 2 * FEW + 2
    assert sum(f.messages for f in heard) == counts_of_help(stand)
    stand.stand_still(15.0)
    left = names_in(stand.nodes["me"])
    assert 0 < len(left) <= 5 * FEW, left  # the latest ones


def counts_of_help(stand: TeamOnBus) -> int:
    counter = stand.nodes["me"].received.flows()
    return sum(f.messages for f in counter if f.topic == "fix")


def visit(stand: TeamOnBus, guest: str, helps: bool) -> None:
    """A guest comes, sees and is seen, helps or is helped, and leaves."""
    token = stand.announce(guest, 0 if helps else 12)
    ear = stand.ear(topics.FIX.at(robot=guest))
    for _ in range(3):
        key = topics.FIX.at(robot="me", tier=0, observer=guest)
        sure = (0.0004, 0.0, 0.0004)
        stand.put(key, Fix("me", guest, stand.now_ns, 0.0, 0.0, sure, sure))
        stand.sightings("me", saw(stand.now_ns, Sighting(guest, 2.0, 0.0)))
        stand.step()
        stand.stand_still(0.1)
    ear.close()
    token.close()
    stand.stand_still(0.1)
    assert stand.now_ns > SECOND // 10
