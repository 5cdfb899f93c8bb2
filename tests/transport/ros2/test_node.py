"""A node of ROS 2 over real Zenoh: what it publishes arrives, and what is wrong is counted."""

import json
import random
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.buses import wait_until
from support.keys import R1, R2, ROUTER, secured_team, shown_by
from support.processes import eventually
from support.ros2_messages import plain, random_message, same
from support.routers import open_router

from cpcbl_launch.run.up import free_endpoint
from cpcbl_transport import zenoh_bus
from cpcbl_transport.bus import LivelinessCallback
from cpcbl_transport.ros2 import names, tokens
from cpcbl_transport.ros2.attachment import Attachment, decode_attachment, encode_attachment, gid_of
from cpcbl_transport.ros2.messages import MARKERS, ODOMETRY, RANGE, TRANSFORMS, Message
from cpcbl_transport.ros2.names import Distribution, Layout, RosNameError
from cpcbl_transport.ros2.node import NodeSettings, RosNode, open_node
from cpcbl_transport.ros2.publisher import RosPublisher
from cpcbl_transport.ros2.qos import DEFAULT, LATCHED, Durability, QosProfile
from cpcbl_transport.ros2.session import RosSession, Sample
from cpcbl_transport.ros2.subscription import Received
from cpcbl_transport.zenoh_bus import BusError


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    where = free_endpoint()
    with open_router("tests", [where]):
        yield where


@pytest.fixture
def node(router: str) -> Iterator[RosNode]:
    with open_node(NodeSettings(connect=(router,))) as opened:
        yield opened


@pytest.fixture
def driver(router: str) -> Iterator[RosNode]:
    with open_node(NodeSettings(connect=(router,), name="driver", namespace="/r1")) as opened:
        yield opened


def hears(node: RosNode, topic: str) -> None:
    """Waits until the node sees who publishes a topic, and thus has its own subscription up."""
    wait_until(lambda: any(e.topic == topic and e.entity == "MP" for e in node.endpoints()))


def publish_until(
    publisher: RosPublisher,
    message: Message,
    condition: Callable[[], bool],
    stamp_ns: int | None = None,
) -> None:
    """Publishes until something has come of it: what a volatile topic says before all know of it is
    lost, as everywhere in ROS 2."""

    def published() -> bool:
        publisher.publish(message, stamp_ns)
        return condition()

    wait_until(published)


def test_messages_arrive_in_order_with_their_stamps(node: RosNode, driver: RosNode) -> None:
    came: list[Received] = []
    publisher = driver.publisher("/r1/odom", "nav_msgs/Odometry")
    node.subscribe("r1/odom", ODOMETRY, came.append)
    hears(node, "r1/odom")
    wait_until(lambda: publisher.matching)
    publish_until(publisher, driver.types.new(ODOMETRY), lambda: bool(came), stamp_ns=1)
    rng = random.Random(7)
    sent = [random_message(driver.types, ODOMETRY, rng) for _ in range(200)]
    for number, message in enumerate(sent):
        publisher.publish(message, stamp_ns=1_000 + number)
        wait_until(lambda least=number - 50: len(came) > least)  # type: ignore[misc]
    wait_until(lambda: came[-1].stamp_ns == 1_000 + len(sent) - 1)
    later = [received for received in came if received.stamp_ns != 1]
    for number, (received, message) in enumerate(zip(later, sent, strict=True)):
        assert same(plain(received.message), plain(message))
        assert (received.topic, received.stamp_ns) == ("r1/odom", 1_000 + number)
        assert received.received_ns >= came[0].received_ns
    assert len({received.gid for received in came}) == 1
    assert node.findings() == []
    assert not node.counts()


def test_a_late_subscriber_of_a_transient_local_topic_gets_the_last_messages(
    node: RosNode, driver: RosNode
) -> None:
    """One that comes after the publisher, and one that was there before it."""
    profile = QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=2)
    early: list[Received] = []
    node.subscribe("tf_static", TRANSFORMS, early.append, profile)
    publisher = driver.publisher("tf_static", TRANSFORMS, profile)
    rng = random.Random(8)
    sent = [random_message(driver.types, TRANSFORMS, rng) for _ in range(3)]
    for message in sent:
        publisher.publish(message)
    last = [plain(message) for message in sent[1:]]
    wait_until(lambda: [plain(r.message) for r in early][-2:] == last)  # none is under way now
    late: list[Received] = []
    node.subscribe("tf_static", TRANSFORMS, late.append, profile)
    wait_until(lambda: len(late) == 2)
    assert [plain(r.message) for r in late] == last
    assert not node.counts()["tf_static", "cut_short"]


def test_a_session_with_a_transient_local_subscription_ends(router: str) -> None:
    """Also while messages arrive; what hung in zenoh-python (issue 624) ends here."""
    with open_node(NodeSettings(connect=(router,))) as speaker:
        publisher = speaker.publisher("map", MARKERS, LATCHED)
        listener = open_node(NodeSettings(connect=(router,)))
        arrived = threading.Event()
        listener.subscribe("map", MARKERS, lambda _: arrived.set(), LATCHED)
        publisher.publish(speaker.types.new(MARKERS))
        assert arrived.wait(40.0)
        listener.close()
        listener.close()


def announcements() -> tuple[list[str], LivelinessCallback]:
    """A list, and what adds to it each token that comes."""
    seen: list[str] = []

    def note(key: str, present: bool) -> None:
        if present:
            seen.append(key)

    return seen, note


class Stranger:
    """Puts anything under the key of a topic, as if it were a publisher of rmw_zenoh."""

    def __init__(self, session: RosSession, key: str) -> None:
        self._publisher = session.publisher(key, DEFAULT)
        self._gid, self._number = gid_of(f"{key} {session.id}"), 0

    def attachment(self, skipped: int = 0) -> bytes:
        self._number += 1 + skipped
        return encode_attachment(Attachment(self._number, 5, self._gid))

    def put(self, payload: bytes, attachment: bytes | None = None, skipped: int = 0) -> None:
        attached = self.attachment(skipped) if attachment is None else attachment
        self._publisher.put(payload, attached or None)


def put_until(stranger: Stranger, payload: bytes, has_come: Callable[[], bool]) -> None:
    """Puts a payload, and again where it has not come after some time: the first of a key may be
    lost, also where the publisher matches."""
    for _ in range(20):
        stranger.put(payload)
        if eventually(has_come, within_s=2.0):
            return
    raise AssertionError("nothing has come")


def test_what_cannot_be_read_is_counted_by_reason_and_the_node_goes_on(
    node: RosNode, router: str, caplog: pytest.LogCaptureFixture
) -> None:
    came: list[Received] = []
    node.subscribe("r9/range", RANGE, came.append, largest_bytes=200)
    good = node.types.encode(node.types.new(RANGE, range=3.0))
    session = RosSession.open([router])

    def refused_hashes() -> int:
        return node.counts()["r9/range", "unknown_type_hash"]

    try:
        for type_hash in (node.types.type_hash(RANGE), "RIHS01_feed"):
            key = names.rmw_zenoh_key(0, "r9/range", RANGE, type_hash)
            stranger = Stranger(session, key)
            is_known = type_hash != "RIHS01_feed"
            put_until(stranger, good, lambda k=is_known: bool(came if k else refused_hashes()))  # type: ignore[misc]
            stranger.put(good)
            stranger.put(good)
            stranger.put(good[:-5])
            stranger.put(good + bytes(5))
            stranger.put(b"\0\7" + good[2:])
            stranger.put(good + bytes(500))
            stranger.put(good, b"sequence_number")
            stranger.put(good, b"")
            stranger.put(good, skipped=4)
            stranger.put(good)
        expected = {"cut_short": 1, "too_long": 1, "no_cdr": 1, "too_large": 2, "no_attachment": 4}
        expected |= {"unknown_type_hash": 8, "lost": 2 * 4}
        wait_until(lambda: node.counts().total() >= sum(expected.values()))
    finally:
        session.close()
    assert {reason: n for (_, reason), n in node.counts().items()} == expected
    assert {received.message.range for received in came} == {3.0}
    (refused,) = [line for line in node.findings() if "payloads were refused" in line]
    assert "no_attachment 4, no_cdr 1, too_large 2, too_long 1, unknown_type_hash" in refused
    assert "r9/range: 8 messages were published and did not arrive" in node.findings()
    said = [record.message for record in caplog.records if "is refused" in record.message]
    assert len(said) == len(expected) - 1, said  # each reason once


def test_it_comes_back_after_the_router_was_away() -> None:
    """Tokens and messages alike, also of a transient local topic."""
    where = free_endpoint()
    first = open_router("tests", [where])
    came: list[Received] = []
    settings = NodeSettings(connect=(where,))
    with open_node(settings) as node, open_node(settings) as driver:
        publisher = driver.publisher("r1/odom", ODOMETRY)
        node.subscribe("r1/odom", ODOMETRY, came.append)
        hears(node, "r1/odom")
        first.close()
        wait_until(
            lambda: not any(e.topic == "r1/odom" and e.entity == "MP" for e in node.endpoints())
        )
        with open_router("tests", [where]):
            hears(node, "r1/odom")
            before = len(came)
            publish_until(publisher, driver.types.new(ODOMETRY), lambda: len(came) > before)
            assert any(e.entity == "NN" for e in node.endpoints())


def test_behind_the_dds_bridge_keys_are_bare_and_nothing_is_attached(router: str) -> None:
    settings = NodeSettings(connect=(router,), layout=Layout.ROS2DDS, domain=3)
    samples: list[Sample] = []
    came: list[Received] = []
    seen, note = announcements()
    session = RosSession.open([router])
    session.subscribe("r1/amcl/odom", DEFAULT, samples.append)
    session.watch_liveliness(tokens.ROS2DDS_TOKENS, note)
    with open_node(settings) as node, open_node(settings) as driver:
        publisher = driver.publisher("/r1/amcl/odom", ODOMETRY)
        node.subscribe("r1/amcl/odom", ODOMETRY, came.append)
        hears(node, "r1/amcl/odom")
        message = node.types.new(ODOMETRY, child_frame_id="base_link")
        publish_until(publisher, message, lambda: bool(samples) and bool(came))
        assert not node.findings()
    session.close()
    assert (samples[0].key, samples[0].attachment) == ("r1/amcl/odom", None)
    assert (came[0].stamp_ns, came[0].gid) == (None, b"")
    assert came[0].message.child_frame_id == "base_link"
    (token,) = [key for key in seen if "/MP/" in key]
    type_hash = node.types.type_hash(ODOMETRY)
    assert token.endswith(
        f"/@ros2_lv/MP/r1§amcl§odom/nav_msgs§msg§Odometry/:1:0:0,10:typehash={type_hash};"
    )
    assert not any("/MS/" in key for key in seen)


def test_what_is_attached_names_the_publisher_by_its_token(router: str) -> None:
    samples: list[Sample] = []
    seen, note = announcements()
    session = RosSession.open([router])
    session.subscribe("4/r1/tf/**", DEFAULT, samples.append)
    session.watch_liveliness(tokens.RMW_ZENOH_TOKENS, note)
    settings = NodeSettings(connect=(router,), domain=4, distribution=Distribution.HUMBLE)
    with open_node(settings) as node:
        publisher = node.publisher("r1/tf", TRANSFORMS)
        publish_until(publisher, node.types.new(TRANSFORMS), lambda: bool(samples), stamp_ns=77)
        wait_until(lambda: any("/MP/" in key and "/4/" in key for key in seen))
    session.close()
    (token,) = [key for key in seen if "/MP/" in key and "/4/" in key]
    attachment = decode_attachment(samples[0].attachment or b"")
    assert attachment is not None
    assert (attachment.source_stamp_ns, attachment.gid) == (77, gid_of(token))
    assert samples[0].key == "4/r1/tf/tf2_msgs::msg::dds_::TFMessage_/TypeHashNotSupported"


def test_a_router_as_that_of_rmw_zenoh_serves_it(tmp_path: Path) -> None:
    """Its lease is a minute, and it adds time stamps to messages."""
    where, path = free_endpoint(), tmp_path / "router.json5"
    config = {
        "mode": "router",
        "listen": {"endpoints": [where]},
        "scouting": {"multicast": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {"link": {"tx": {"lease": 60_000, "keep_alive": 2}}},
    }
    path.write_text(json.dumps(config))
    came: list[Received] = []
    settings = NodeSettings(connect=(where,))
    with (
        zenoh_bus.open_router(zenoh_bus.read_router_config(path)),
        open_node(settings) as node,
        open_node(settings) as driver,
    ):
        node.subscribe("tf_static", TRANSFORMS, came.append, LATCHED)
        driver.publisher("tf_static", TRANSFORMS, LATCHED).publish(node.types.new(TRANSFORMS))
        wait_until(lambda: bool(came))


def test_links_are_mutual_tls_with_credentials(tmp_path: Path) -> None:
    team, where = secured_team(tmp_path), free_endpoint("tls")
    came: list[Received] = []
    with open_router("tests", [where], credentials=shown_by(team, ROUTER)):
        settings = NodeSettings(connect=(where,), credentials=shown_by(team, R1))
        other = NodeSettings(connect=(where,), credentials=shown_by(team, R2))
        with open_node(settings) as node, open_node(other) as driver:
            publisher = driver.publisher("r1/odom", ODOMETRY)
            node.subscribe("r1/odom", ODOMETRY, came.append)
            hears(node, "r1/odom")
            publish_until(publisher, node.types.new(ODOMETRY), lambda: bool(came))


def test_a_users_errors_have_one_line(router: str) -> None:
    with pytest.raises(RosNameError, match="domain 300"):
        open_node(NodeSettings(connect=(router,), domain=300))
    with pytest.raises(RosNameError, match="node 'a/b'"):
        open_node(NodeSettings(connect=(router,), name="a/b"))
    with pytest.raises(BusError, match="no router at"):
        open_node(NodeSettings(connect=(free_endpoint(),)), give_up=iter((False, True)).__next__)
    with open_node(NodeSettings(connect=(router,))) as node:
        with pytest.raises(RosNameError, match="topic"):
            node.subscribe("r1/**", ODOMETRY, print)
        publisher = node.publisher("r1/odom", ODOMETRY)
        with pytest.raises(ValueError, match="carries nav_msgs/msg/Odometry"):
            publisher.publish(node.types.new(RANGE))
        publisher.close()
        publisher.publish(node.types.new(ODOMETRY))
        assert len(node.findings()) == 1  # that nobody else is there
