"""The router remembers which robots have run and moved, also where it certifies names."""

from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from support.buses import wait_until
from support.keys import R1, R2, ROUTER, secured_team, session, shown_by
from support.routers import open_router

from cpcbl_agents.earlier_processes import (
    NEVER_RAN,
    EarlierRuns,
    OwnTokens,
    repeat_tokens,
    wait_until_alone,
)
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.security import Identity, access_control
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus


def before(bus: ZenohBus, robot: str = "r1") -> EarlierRuns:
    return EarlierRuns.from_tokens(bus.tokens(topics.RAN.at(robot=robot)))


def check(first: ZenohBus, second: ZenohBus, other: ZenohBus) -> None:
    """`first` and `second` are of processes of r1, `other` of r2."""
    assert before(first) == before(other, "r2") == NEVER_RAN
    tokens = OwnTokens(first, "r1", "1")
    wait_until(lambda: before(second) == EarlierRuns(ran=True))
    tokens.declare_moved()
    tokens.declare_moved()
    wait_until(lambda: len(second.tokens(topics.RAN.at(robot="r1"))) == 4)
    first.close()
    wait_until(lambda: len(second.tokens(topics.RAN.at(robot="r1"))) == 2)  # the router's
    assert before(second) == EarlierRuns(moved=True, ran=True)
    assert before(other, "r2") == NEVER_RAN


def test_a_router_remembers_who_has_moved() -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        repeat_tokens(stack.enter_context(open_router("lab", [endpoint])))
        check(*(stack.enter_context(open_bus("lab", [endpoint])) for _ in range(3)))


def beside_a_robot_that_moved(stack: ExitStack, endpoint: str) -> tuple[ZenohBus, ZenohBus]:
    """A router, and the session of a robot that told it that it has moved."""
    router = open_router("lab", [endpoint])
    repeat_tokens(router)
    robot = stack.enter_context(open_bus("lab", [endpoint]))
    OwnTokens(robot, "r1", "1").declare_moved()
    return router, robot


def test_a_router_that_is_started_again_learns_it_from_a_later_process_that_stands() -> None:
    """The second process of a robot knew that it had moved, and told nobody: killed beside the
    next router, its third one was certain of a start that the robot had left long ago."""
    with ExitStack() as stack:
        endpoint = free_endpoint()
        router, first = beside_a_robot_that_moved(stack, endpoint)
        second = stack.enter_context(open_bus("lab", [endpoint]))
        wait_until(lambda: len(second.tokens(topics.RAN.at(robot="r1"))) == 4)
        first.close()
        OwnTokens(second, "r1", "2", wait_until_alone(second.tokens, "r1"))
        router.close()
        repeat_tokens(stack.enter_context(open_router("lab", [endpoint])))
        third = stack.enter_context(open_bus("lab", [endpoint]))
        wait_until(lambda: len(third.tokens(topics.RAN.at(robot="r1"))) == 4)
        second.close()
        assert wait_until_alone(third.tokens, "r1") == EarlierRuns(moved=True, ran=True)


def test_a_router_that_is_started_again_does_not_know_who_was_killed_before_it() -> None:
    """What nobody is left to tell it: docs/deployment.md says what to do."""
    with ExitStack() as stack:
        endpoint = free_endpoint()
        router, first = beside_a_robot_that_moved(stack, endpoint)
        first.close()
        router.close()
        repeat_tokens(stack.enter_context(open_router("lab", [endpoint])))
        second = stack.enter_context(open_bus("lab", [endpoint]))
        assert wait_until_alone(second.tokens, "r1") == NEVER_RAN


def test_a_second_process_of_a_robot_waits_for_the_first_and_then_gives_up() -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        repeat_tokens(stack.enter_context(open_router("lab", [endpoint])))
        first, second, other = (stack.enter_context(open_bus("lab", [endpoint])) for _ in range(3))
        assert wait_until_alone(first.tokens, "r1") == NEVER_RAN
        OwnTokens(first, "r1", "1")
        wait_until(lambda: before(second) == EarlierRuns(ran=True))
        with pytest.raises(InputError, match="robot r1: another process is this robot already"):
            wait_until_alone(second.tokens, "r1", within_s=0.3)
        assert wait_until_alone(other.tokens, "r2", within_s=0.0) == NEVER_RAN
        asked: list[str] = []

        def ends_meanwhile(keys: str) -> list[str]:
            asked.append(keys)
            if len(asked) == 2:
                first.close()
            return second.tokens(keys)

        assert wait_until_alone(ends_meanwhile, "r1") == EarlierRuns(ran=True)
        assert len(asked) >= 2


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Team:
    folder: Path = tmp_path_factory.mktemp("keys")
    return secured_team(folder)


def member(stack: ExitStack, team: Team, who: Identity, endpoint: str) -> ZenohBus:
    bus = stack.enter_context(closing(session(team, who, endpoint)))
    assert isinstance(bus, ZenohBus)
    return bus


def test_so_does_one_that_certifies_names(team: Team) -> None:
    endpoint = free_endpoint("tls")
    keys = {"guards": access_control(team), "credentials": shown_by(team, ROUTER)}
    with ExitStack() as stack:
        repeat_tokens(stack.enter_context(open_router(team.name, [endpoint], **keys)))  # type: ignore[arg-type]
        check(*(member(stack, team, who, endpoint) for who in (R1, R1, R2)))
