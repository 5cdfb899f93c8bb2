"""dora-rs, an independent implementation of rmw_zenoh's wire: it hears and is heard."""

import json
import random
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.buses import wait_until
from support.ros2_messages import plain, random_message, same
from support.ros2_partners import DOMAIN, dora_echo, write_prefix
from support.routers import open_router

from cpcbl_launch.run.up import free_endpoint
from cpcbl_transport.ros2.messages import MESSAGE_TYPES
from cpcbl_transport.ros2.names import Distribution
from cpcbl_transport.ros2.node import NodeSettings, RosNode, open_node
from cpcbl_transport.ros2.qos import DEFAULT
from cpcbl_transport.ros2.subscription import Received

pytestmark = pytest.mark.ros2
EACH = 1000
IN_FLIGHT = 16  # dora-rs keeps 64 messages, and drops what comes then
TOPICS = [(name.split("/")[2].lower(), name) for name in MESSAGE_TYPES]


class Echoes:
    """What came back, by topic; lets few messages be on their way."""

    def __init__(self) -> None:
        self._came = threading.Condition()
        self.messages: dict[str, list[Received]] = {topic: [] for topic, _ in TOPICS}

    def add(self, received: Received) -> None:
        with self._came:
            self.messages[received.topic.removesuffix("_echo")].append(received)
            self._came.notify()

    def wait_for(self, topic: str, count: int) -> None:
        with self._came:
            assert self._came.wait_for(lambda: len(self.messages[topic]) >= count, 40.0), topic


@pytest.fixture(params=[Distribution.KILTED, Distribution.HUMBLE])
def node(request: pytest.FixtureRequest) -> Iterator[RosNode]:
    router = free_endpoint()
    settings = NodeSettings(
        connect=(router,), domain=DOMAIN, distribution=request.param, namespace="/team"
    )
    with open_router("tests", [router]), open_node(settings) as opened:
        yield opened


def test_a_thousand_messages_of_each_type_pass_both_ways(node: RosNode, tmp_path: Path) -> None:
    """None is lost or changed; each side sees the node and the topics of the other one."""
    echoes, rng = Echoes(), random.Random(21)
    publishers = {topic: node.publisher(topic, name) for topic, name in TOPICS}
    for topic, name in TOPICS:
        node.subscribe(f"{topic}_echo", name, echoes.add, DEFAULT)
    (router,), distribution = node.settings.connect, node.settings.distribution
    write_prefix(tmp_path, distribution)
    first: dict[str, object] = {}
    with dora_echo(router, distribution, TOPICS, tmp_path) as lines:
        wait_until(lambda: len([e for e in node.endpoints() if e.node == "echo"]) == 25)
        for topic, name in TOPICS:
            sent = []
            for number in range(EACH):
                message = random_message(node.types, name, rng)
                sent.append(plain(message))
                publishers[topic].publish(message)
                echoes.wait_for(topic, number + 1 - IN_FLIGHT)
            echoes.wait_for(topic, EACH)
            came = [plain(received.message) for received in echoes.messages[topic]]
            assert all(map(same, came, sent)), name
            first[topic] = sent[0]
        assert not node.findings()
        assert not node.counts()
    _check_what_dora_saw(lines, first, distribution)


def _check_what_dora_saw(
    lines: list[str], first: dict[str, object], distribution: Distribution
) -> None:
    """Its own reading of the first message of each topic, and the tokens in its log."""
    printed = dict(line.split(" ", 1) for line in lines[:-2])
    assert printed.keys() == first.keys()
    for topic, text in printed.items():
        (message,) = json.loads(text)
        assert same(_narrow(message), _narrow(first[topic])), topic
    node_token = f"@ros2_lv/{DOMAIN}/"
    seen = [line for line in lines[-1].splitlines() if node_token in line and "%team" in line]
    kinds = [line.split("/")[5] for line in seen]
    assert kinds.count("NN") == 1
    assert kinds.count("MP") == kinds.count("MS") == len(TOPICS)
    hashed = [("TypeHashNotSupported" in line) for line in seen if "/NN/" not in line]
    assert set(hashed) == {not distribution.has_type_hashes}


def _narrow(value: object) -> object:
    """Values as Arrow gives them: numbers and booleans are alike."""
    if isinstance(value, dict):
        return {key: _narrow(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_narrow(item) for item in value]
    return float(value) if isinstance(value, int | float) else value
