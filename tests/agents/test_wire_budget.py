"""What fixes and beliefs take on real links, with and without a budget."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import pytest
from support.buses import (
    MS,
    Subscription,
    robot_at,
    saw,
    team_of,
    wait_until,
)
from support.wire_tap import Batch, Kind, most_in_window, total
from support.wired_team import GOOD, POOR, repeat_until, said, wired

from cpcbl_team.config import (
    BudgetSettings,
)
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.compact import BELIEF_BYTES, FIX_BYTES, received_bytes, sent_bytes
from cpcbl_transport.messages import Spending
from cpcbl_transport.zenoh_bus import open_bus


def data(batches: Sequence[Batch]) -> list[Batch]:
    return [batch for batch in batches if batch.kind is Kind.DATA]


MATES = ("mate-one", "mate-two", "another", "worse", "worst")


class Spent(NamedTuple):
    """What a robot sent and when, by its own time in tenths of a second."""

    batches: list[Batch]
    spending: Spending
    over_budget: int

    @property
    def most(self) -> int:
        return most_in_window(self.batches, 100)

    def per_s(self) -> float:
        """From the first byte on."""
        tenths = self.batches[-1].at_s - self.batches[0].at_s + 1
        return total(self.batches) / tenths * 10.0


def spent(bytes_per_s: float, seconds: int, at_once: int = 1) -> Spent:
    """By a robot that would always like to send five fixes a frame, and beliefs.

    Nothing is too little worth; its teammates are played by a session of the test's own. So many
    frames come at once, 10 a second in all. Each step waits until all that the robot has sent has
    gone through its link.
    """
    rules: dict[str, Any] = {
        "budget": BudgetSettings(bytes_per_s=bytes_per_s),
        "least_value": 0.0,
        "belief_share": 0.0,
    }
    team = team_of(
        observer=robot_at(sigma_m=GOOD, **rules), **{name: robot_at(2.0) for name in MATES}
    )
    with wired(team, "observer") as robots, open_bus(team.name, [robots.endpoint]) as mates:
        ears = [Subscription(mates, topics.FIX.at(robot=name)) for name in MATES]
        ears.append(Subscription(mates, topics.BELIEF.at(robot="observer")))
        for tier, name in enumerate(MATES, start=10):
            mates.declare_token(topics.ALIVE.at(tier=tier, robot=name, incarnation="1"))
        stand, (link,) = robots.stand, robots.links.values()
        agent = stand.robots["observer"].collaboration
        batches, frames = list[Batch](), list[Sightings]()

        def look() -> None:
            stand.stand_still(0.1)
            turn = stand.now_ns * 1e-9  # they walk round it
            sights = (Sighting(name, 1.0 + n, wrap_angle(turn + n)) for n, name in enumerate(MATES))
            frames.append(saw(stand.now_ns, *sights))
            if len(frames) == at_once:
                for frame in frames:
                    stand.sightings("observer", frame)
                frames.clear()
            stand.step()
            wait_until(lambda: sum(len(ear.samples) for ear in ears) == said(agent))
            new = data(link.up)[len(batches) :]
            batches.extend(batch._replace(at_s=stand.now_ns // (100 * MS)) for batch in new)

        repeat_until(look, lambda: bool(batches))
        for _ in range(10 * seconds):
            look()
        (spending,) = agent.budget.spending(stand.now_ns)
    return Spent(batches, spending, sum(f.over_budget for f in agent.counters.flows()))


@pytest.mark.parametrize("at_once", [1, 10], ids=["steady", "stuttering"])
@pytest.mark.parametrize(
    ("bytes_per_s", "seconds"),
    [
        pytest.param(50, 120, marks=pytest.mark.thorough),
        (200, 60),
        pytest.param(1000, 30, marks=pytest.mark.thorough),
    ],
)
def test_a_budget_holds_over_any_ten_seconds_on_the_link(
    bytes_per_s: int, seconds: int, at_once: int
) -> None:
    seen = spent(bytes_per_s, seconds, at_once)
    assert seen.most <= 10 * bytes_per_s
    assert seen.per_s() > (0.6 if at_once == 1 else 0.5) * bytes_per_s
    assert seen.over_budget > 0
    assert seen.most <= seen.spending.most <= min(1.25 * seen.most, seen.spending.allowed)


def test_without_a_budget_the_same_robot_sends_more() -> None:
    assert spent(1e6, 12).most > 12_000


@pytest.mark.parametrize(
    ("kinds", "payload"),
    [({"passive": False}, FIX_BYTES), ({"active": False}, BELIEF_BYTES)],
    ids=["fix", "belief"],
)
def test_a_fix_and_a_belief_are_small_on_both_links(kinds: dict[str, Any], payload: int) -> None:
    """Under the keys of robots with names of eight letters."""
    rules = {"least_value": 0.0, "belief_share": 0.0, **kinds}
    team = team_of(
        observer=robot_at(sigma_m=GOOD, **rules), teammate=robot_at(2.0, sigma_m=POOR, **rules)
    )
    with wired(team) as robots:
        better, worse = robots.links.values()

        def step() -> None:
            robots.exchange()
            time.sleep(0.2)  # so that no two are in one batch

        repeat_until(step, lambda: min(len(data(better.up)), len(data(worse.down))) >= 12)
    assert payload <= 40
    for batches, most in (
        (data(better.up), sent_bytes(payload)),
        (data(worse.down), received_bytes(payload, "observer")),
    ):
        batches = batches[2:]  # the first may hold a fix that waited for the subscription, too
        assert [batch.size for batch in batches if not payload < batch.size <= min(60, most)] == []
