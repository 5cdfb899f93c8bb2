"""Guests: who is let in, how many, how they are looked up, and help in both directions."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.buses import SECOND, TeamOnBus, examples, robot_at, saw, team_of

from cpcbl_agents.guests import FORGET_NS, LOOKUP_NS, GuestRegistry
from cpcbl_team.config import GuestSettings, RobotSettings, SensorSettings, Team
from cpcbl_team.inputs import Fix, Sighting
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport import topics
from cpcbl_transport.bus import Handle, LivelinessCallback
from cpcbl_transport.memory_bus import MemoryBus, MemoryHub
from cpcbl_transport.messages import Status

GOOD, POOR = 0.01, 0.3
EXACT = SensorSettings(field_of_view_deg=360.0, range_share=0.0, range_floor_m=1e-4)


# The guests of one robot, by themselves ---------------------------------------------------------


def test_a_candidate_is_a_guest_while_its_token_is_there() -> None:
    guests = GuestRegistry(most=2)
    assert guests.notice("tripod", 0)
    assert guests.watched_robots == {"tripod"}
    assert "tripod" not in guests
    guests.set_presence("tripod", True)
    guests.set_presence("tripod", True)  # at a change of tier
    assert "tripod" in guests
    guests.set_presence("tripod", False)
    assert "tripod" not in guests
    assert guests.counts == {"guest_joined": 1, "guest_left": 1}


def test_a_known_name_is_no_candidate_and_an_unnoticed_robot_is_no_guest() -> None:
    guests = GuestRegistry({"oak", "mate", "me"}, 2)
    for name in ("oak", "mate", "me"):
        assert not guests.notice(name, 0)
        guests.set_presence(name, True)
        assert name not in guests
    guests.set_presence("tripod", True)
    assert "tripod" not in guests
    assert guests.watched_robots == frozenset()
    assert not guests.counts


def test_a_team_without_guests_has_no_candidates() -> None:
    guests = GuestRegistry(most=0)
    assert not guests.notice("tripod", 0)
    assert guests.watched_robots == frozenset()


def test_a_candidate_without_a_token_loses_its_place_a_guest_does_not() -> None:
    guests = GuestRegistry(most=2)
    guests.notice("tripod", 0)
    guests.set_presence("tripod", True)
    assert guests.notice("garbage", 0)
    assert not guests.notice("late", LOOKUP_NS - 1)
    assert not guests.notice("new", LOOKUP_NS)
    assert guests.counts["guest_refused"] == 2
    assert guests.notice("late", LOOKUP_NS)  # it comes again
    assert guests.watched_robots == {"tripod", "late"}
    for time_ns in range(0, FORGET_NS, LOOKUP_NS):
        assert not guests.notice("garbage", LOOKUP_NS + time_ns)  # in vain before
    assert guests.notice("garbage", LOOKUP_NS + FORGET_NS)
    assert guests.notice("late", 2 * LOOKUP_NS + FORGET_NS) is False
    guests = GuestRegistry(most=2)
    for name in ("tripod", "late"):
        guests.notice(name, 0)
    guests.set_presence("tripod", True)
    guests.set_presence("late", True)
    assert not guests.notice("third", 100 * LOOKUP_NS)
    assert guests.watched_robots == {"tripod", "late"}


def test_every_robot_that_is_seen_all_the_time_is_looked_up() -> None:
    guests = GuestRegistry(most=3)
    turns: set[str] = set()
    for frame in range(100):
        for number in range(12):
            guests.notice(f"g{number}", frame * LOOKUP_NS // 10)
        turns |= guests.watched_robots
    assert len(turns) == 12


def test_strangers_are_forgotten_some_time_after_they_were_noticed_guests_are_not() -> None:
    guests = GuestRegistry(most=3)
    for name in ("tripod", "garbage"):
        guests.notice(name, 0)
    guests.notice("garbage", SECOND)
    guests.set_presence("tripod", True)
    guests.forget(FORGET_NS + SECOND)
    assert guests.watched_robots == {"tripod", "garbage"}
    guests.forget(FORGET_NS + SECOND + 1)
    assert guests.watched_robots == {"tripod"}
    guests.set_presence("tripod", False)
    guests.forget(FORGET_NS + SECOND + 1)
    assert guests.watched_robots == frozenset()


@examples(100)
@given(
    st.lists(
        st.tuples(st.sampled_from(["noticed", "came", "went"]), st.text("abcdef", max_size=2))
    ),
    st.integers(0, 5),
)
def test_whatever_happens_there_are_never_more_than_allowed(
    events: list[tuple[str, str]], most: int
) -> None:
    guests = GuestRegistry({"a"}, most)
    for number, (event, name) in enumerate(events):
        now_ns = number * LOOKUP_NS // 3
        if event == "noticed":
            guests.notice(name, now_ns)
        else:
            guests.set_presence(name, event == "came")
        guests.forget(now_ns)
        assert len(guests.watched_robots) <= most
        here = {n for _, n in events if n in guests}
        assert here <= guests.watched_robots
        assert "a" not in guests.watched_robots


# Help, both ways, over the bus in memory --------------------------------------------------------


def external(x_m: float, y_m: float, heading_deg: float, sigma_m: float, **more: Any) -> Any:
    return replace(robot_at(x_m, y_m, heading_deg, sigma_m=sigma_m), **more)


class WithGuest:
    """The robot `me` of a team that has a `mate` too, who is away, and a guest two metres ahead."""

    def __init__(
        self,
        me: RobotSettings,
        tripod: RobotSettings | None = None,
        guests: GuestSettings | None = None,
    ) -> None:
        team = replace(team_of(me=me, mate=robot_at(9.0, 9.0)), guests=guests or GuestSettings())
        tripod = tripod or external(2.0, 0.0, 180.0, GOOD)
        self.me = TeamOnBus(team, here=["me"])
        self.guest = TeamOnBus(
            Team(name="tests", robots={**team.robots, "tripod": tripod}, map=team.map),
            here=["tripod"],
            hub=self.me.hub,
        )

    def go_on(self, seconds: float, *, i_see: bool = True, it_sees: bool = True) -> None:
        """Both stand; at 5 Hz they see each other, or not."""
        for _ in range(round(5 * seconds)):
            for stand in (self.me, self.guest):
                stand.stand_still(0.2)
            if i_see:
                self.me.sightings("me", saw(self.me.now_ns, Sighting("tripod", 2.0, 0.0)))
            if it_sees:
                self.guest.sightings("tripod", saw(self.guest.now_ns, Sighting("me", 2.0, 0.0)))
            for _ in range(3):
                for stand in (self.me, self.guest):
                    stand.step()

    def sigma_m(self) -> float:
        return self.me.robots["me"].filter.timeline.state.estimate.position_sigma_m

    def status(self) -> Status:
        return self.me.status("me")

    def leave(self) -> None:
        """Its session ends: nothing of it is heard or announced any more."""
        for node in self.guest.nodes.values():
            node._declarations._bus.close()


def poor(**more: Any) -> RobotSettings:
    """It is at the origin, but does not know it."""
    robot: RobotSettings = external(0.1, 0.1, 0.0, POOR, **more)
    return robot


def test_fixes_of_a_guest_that_no_file_names_are_used() -> None:
    """Also if the helped robot never sees the guest: the first fix makes it look the guest up."""
    both = WithGuest(poor())
    both.go_on(1.0, i_see=False)
    assert both.sigma_m() < 0.1
    pose = both.me.robots["me"].filter.timeline.state.estimate.pose
    assert (pose.x, pose.y) == pytest.approx((0.0, 0.0), abs=0.04)
    status = both.status()
    assert [flow.peer for flow in status.heard if flow.topic == "fix"] == ["tripod"]
    assert status.counts["guest_joined"] == 1
    # The first fix found no subscription; it came once more, with the next one.
    assert 1 <= status.counts["unknown_robot"] <= 2


def test_a_guest_that_does_not_look_is_a_landmark() -> None:
    both = WithGuest(poor())
    both.go_on(1.5, it_sees=False)
    assert both.sigma_m() < 0.25
    status = both.status()
    assert [flow.peer for flow in status.heard] == ["tripod"]
    assert {flow.topic for flow in status.heard} == {"belief"}
    assert "unknown_robot" not in status.counts
    assert status.counts["unknown_object"] == 1  # until it was known


def test_without_noise_a_fix_of_a_guest_is_exact() -> None:
    tripod = external(2.0, 0.0, 180.0, 1e-6, sensor=replace(EXACT, bearing_sigma_deg=1e-4))
    start = replace(robot_at(2.0, 0.0, 180.0).start, sigma_m=1e-6, heading_sigma_deg=1e-4)  # type: ignore[type-var]
    both = WithGuest(poor(), replace(tripod, start=start))
    both.go_on(1.0, i_see=False)
    pose = both.me.robots["me"].filter.timeline.state.estimate.pose
    assert (pose.x, pose.y) == pytest.approx((0.0, 0.0), abs=1e-5)


def test_a_robot_helps_a_guest_that_knows_less_and_is_not_helped_by_it() -> None:
    both = WithGuest(external(0.0, 0.0, 0.0, GOOD), external(2.1, 0.1, 180.0, POOR))
    both.go_on(1.0)
    theirs = both.guest.status("tripod")
    assert theirs.position_sigma_m < 0.1
    assert {flow.peer for flow in theirs.heard} == {"me"}
    assert theirs.sent == ()
    assert both.status().heard == ()


def test_a_guest_leaves_and_comes_again() -> None:
    both = WithGuest(poor())
    both.go_on(1.0)
    both.leave()
    both.me.stand_still(0.5)
    counts = both.status().counts
    assert (counts["guest_joined"], counts["guest_left"]) == (1, 1)
    assert both.me.robots["me"].collaboration.sources == frozenset()
    again = WithGuest(poor())
    again.me.announce("tripod", 3).close()
    again.go_on(1.0)
    assert again.status().counts["guest_joined"] == 1


def test_a_team_without_guests_takes_no_help_from_one_and_counts_it() -> None:
    both = WithGuest(poor(), guests=GuestSettings(allowed=False))
    before_m = both.sigma_m()
    both.go_on(1.0)
    assert both.sigma_m() >= before_m
    status = both.status()
    assert status.heard == ()
    assert status.counts["unknown_robot"] > 1
    assert status.counts["unknown_object"] > 1
    assert "guest_joined" not in status.counts


def test_a_sender_without_a_token_is_never_a_guest() -> None:
    stand = TeamOnBus(team_of(me=poor(), mate=robot_at(9.0, 9.0)), here=["me"])
    stand.stand_still(0.3)
    key = topics.FIX.at(robot="me", tier=0, observer="ghost")
    for _ in range(5):
        small = (1e-6, 0.0, 1e-6)
        stand.put(key, Fix("me", "ghost", stand.now_ns, 0.0, 0.0, small, small))
        stand.stand_still(0.1)
    assert stand.status("me").counts["unknown_robot"] == 5
    assert stand.robots["me"].filter.timeline.state.estimate.position_sigma_m > 0.2


def test_a_blind_robot_sees_guests_too() -> None:
    blind = SensorSettings(field_of_view_deg=360.0, sees_landmarks=False)
    both = WithGuest(poor(sensor=blind))
    both.go_on(1.5, it_sees=False)
    assert both.sigma_m() < 0.25


# What looking somebody up costs -----------------------------------------------------------------


class Watched(MemoryBus):
    """Remembers what is watched at present."""

    def __init__(self, hub: MemoryHub) -> None:
        super().__init__(hub)
        self.keys: list[str] = []
        self.declared_so_far = 0

    def watch_liveliness(self, keys: str, watch: LivelinessCallback) -> Handle:
        inner = super().watch_liveliness(keys, watch)
        self.keys.append(keys)
        self.declared_so_far += 1
        mine = self.keys

        class Closing:
            def close(self) -> None:
                if keys in mine:
                    mine.remove(keys)
                inner.close()

        return Closing()


class WatchedHub(MemoryHub):
    """Hands out sessions that can be looked into."""

    def __init__(self) -> None:
        super().__init__()
        self.sessions: list[Watched] = []

    def session(self) -> MemoryBus:
        self.sessions.append(Watched(self))
        return self.sessions[-1]


def test_a_robot_that_was_never_noticed_is_not_watched() -> None:
    hub = WatchedHub()
    stand = TeamOnBus(team_of(me=robot_at(), mate=robot_at(2.0)), here=["me"], hub=hub)
    for i in range(50):
        stand.announce(f"guest{i}", 3)
    stand.stand_still(1.0)
    assert [bus.keys for bus in hub.sessions[1:]] == [[topics.ALIVE.at(robot="me")]]


def test_a_camera_full_of_garbage_makes_a_robot_watch_a_few_names_only() -> None:
    hub, most = WatchedHub(), 4
    team = replace(team_of(me=robot_at()), guests=GuestSettings(most=most))
    stand = TeamOnBus(team, here=["me"], hub=hub)
    stand.announce("tripod", 3)
    (bus,) = hub.sessions[1:]
    for frame in range(100):
        stand.stand_still(0.1)
        names = [f"g{frame}-{i}" for i in range(10)]
        seen = [Sighting(name, 2.0, 0.0) for name in [*names, "tripod"]]
        stand.sightings("me", saw(stand.now_ns, *seen))
        stand.step()
        assert len(bus.keys) <= most + 1
        assert len(stand.robots["me"].collaboration.neighbours) <= most
    assert bus.declared_so_far <= 1 + most * (1 + 10 * SECOND // LOOKUP_NS)
    assert stand.robots["me"].counts["guest_joined"] == 1  # it found its place among them
    stand.stand_still(FORGET_NS / SECOND + 1.0)
    assert bus.keys == [topics.ALIVE.at(robot="me"), topics.ALIVE.at(robot="tripod")]


def test_a_token_with_an_invalid_name_or_tier_makes_no_guest() -> None:
    stand = TeamOnBus(team_of(me=poor()), here=["me"])
    for key in ("alive/99/tripod/1", "alive/x/tripod/1"):
        stand.bus.declare_token(key)
    stand.sightings("me", saw(0, Sighting("tripod", 2.0, 0.0)))
    stand.stand_still(1.0)
    stand.sightings("me", saw(stand.now_ns, Sighting("tripod", 2.0, 0.0)))
    stand.stand_still(0.5)
    assert "guest_joined" not in stand.robots["me"].counts
    assert stand.status("me").counts["bad_token"] == 2


def test_a_robots_own_name_seen_in_a_mirror_is_no_guest() -> None:
    stand = TeamOnBus(team_of(me=robot_at()), here=["me"])
    stand.stand_still(0.3)
    for _ in range(5):
        stand.sightings("me", saw(stand.now_ns, Sighting("me", 2.0, 0.0)))
        stand.stand_still(0.2)
    assert stand.robots["me"].collaboration.neighbours == frozenset()
    assert stand.robots["me"].collaboration.tier < LOWEST_TIER
