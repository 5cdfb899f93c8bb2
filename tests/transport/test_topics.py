"""The table of topics, and that quality flows downhill only."""

from typing import get_args

import pytest
import zenoh
from support.buses import matches

from cpcbl_team.config import CollaborationSettings
from cpcbl_team.tiers import LOWEST_TIER, accepted_tiers
from cpcbl_transport import topics
from cpcbl_transport.messages import Message
from cpcbl_transport.topics import TOPICS, Qos, Topic

TIERS = range(LOWEST_TIER + 1)
per_topic = pytest.mark.parametrize("topic", TOPICS, ids=lambda t: t.key)


def heard(key: str, patterns: list[str]) -> bool:
    return any(matches(pattern, key) for pattern in patterns)


def test_the_table_holds_every_topic_of_the_module() -> None:
    assert set(TOPICS) == {t for t in vars(topics).values() if isinstance(t, Topic)}


def test_no_key_of_one_topic_belongs_to_another() -> None:
    for topic in TOPICS:
        concrete = topic.at(robot="r1", tier=3, observer="r2", incarnation="1")
        assert [other for other in TOPICS if matches(other.at(), concrete)] == [topic]


def test_every_message_is_carried_by_exactly_one_topic() -> None:
    carried = [t.carries for t in TOPICS if t.carries is not None]
    assert sorted(carried, key=str) == sorted(get_args(Message), key=str)


def test_a_robots_inputs_are_the_topics_below_in() -> None:
    assert set(topics.INPUTS) == {t for t in TOPICS if t.key.startswith("in/<robot>/")}


@per_topic
def test_messages_between_robots_have_the_priority_that_costs_nothing(topic: Topic) -> None:
    priority = getattr(zenoh.Priority, topic.qos.value.priority)
    helps = topic.carries in topics.COLLABORATION
    assert (priority == zenoh.Priority.DEFAULT) is helps


def test_commands_go_before_help_help_before_inputs_and_these_before_reports() -> None:
    priorities = [getattr(zenoh.Priority, qos.value.priority) for qos in Qos]
    assert sorted(priorities, key=int) == priorities
    assert list(Qos) == [Qos.COMMAND, Qos.FRESH, Qos.INPUT, Qos.FRAME, Qos.TELEMETRY]


@per_topic
def test_names_that_are_left_out_become_wildcards(topic: Topic) -> None:
    names = [c.strip("<>") for c in topic.key.split("/") if c.startswith("<")]
    filled = topic.at(**{name: f"the-{name}" for name in names})
    assert filled == topic.key.replace("<", "the-").replace(">", "")
    assert topic.at().count("*") == len(names)
    assert matches(topic.at(), filled)


@per_topic
def test_the_names_in_a_key_are_those_it_was_made_with(topic: Topic) -> None:
    names = {c.strip("<>"): f"{n}" for n, c in enumerate(topic.key.split("/")) if c[0] == "<"}
    key = topic.at(**names)
    assert topic.names(key) == names
    assert [other.names(key) for other in TOPICS if other is not topic] == [None] * (
        len(TOPICS) - 1
    )
    assert topic.names(key + "/more") is topic.names(key.rpartition("/")[0]) is None


def test_worked_examples_of_keys() -> None:
    assert topics.FIX.at(robot="r2", tier=3, observer="r1") == "fix/r2/3/r1"
    assert topics.FIX.at(robot="r2", tier=0) == "fix/r2/0/*"
    assert topics.BELIEF.at(tier=3) == "belief/3/*"
    assert topics.TRUTH.at() == "field/truth"


@pytest.mark.parametrize("own", TIERS)
def test_a_robot_subscribes_only_to_better_tiers(own: int) -> None:
    tiers = accepted_tiers(own, CollaborationSettings())
    beliefs = [topics.BELIEF.at(tier=t) for t in tiers]
    fixes = [topics.FIX.at(robot="me", tier=t) for t in tiers]
    for theirs in TIERS:
        better = theirs < own
        assert heard(topics.BELIEF.at(tier=theirs, robot="r1"), beliefs) is better
        assert heard(topics.FIX.at(robot="me", tier=theirs, observer="r1"), fixes) is better
        assert not heard(topics.FIX.at(robot="you", tier=theirs, observer="r1"), fixes)


def test_with_both_ways_a_robot_subscribes_to_all_tiers() -> None:
    tiers = accepted_tiers(0, CollaborationSettings(direction="both-ways"))
    patterns = [topics.BELIEF.at(tier=t) for t in tiers]
    assert all(heard(topics.BELIEF.at(tier=t, robot="r1"), patterns) for t in TIERS)
