"""Payloads that no correct program sends: random bytes, odd structures, damaged messages."""

import random
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec

from cpcbl_team.inputs import Belief, Fix, InitialPose, Odometry, Position, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.compact import encode_help
from cpcbl_transport.messages import (
    VERSION,
    AnnotatedFrame,
    Drive,
    Flow,
    Frame,
    Join,
    Pose,
    Status,
    Track,
    Truth,
    Truths,
    encode,
)
from cpcbl_transport.topics import Topic

COVARIANCE_2, COVARIANCE_3 = (0.04, 0.01, 0.09), (0.04, 0.01, 0.09, 0.0, 0.0, 0.01)
TAGS = (
    *("odometry", "sightings", "position", "initial_pose", "frame", "look"),
    *("status", "track", "pose", "drive", "truth", "join"),
)
LONGEST = 600
DISTINCT = 1000  # hypothesis takes about 4 ms for each
_encode = msgspec.msgpack.Encoder().encode


def valid_payload(topic: Topic, target: str, speaker: str, now_ns: int) -> bytes:
    """A payload that the subscribers of a topic accept."""
    match topic:
        case topics.BELIEF:
            return encode_help(Belief(speaker, now_ns, 1.0, 2.0, 0.5, COVARIANCE_3))
        case topics.FIX:
            fix = Fix(target, speaker, now_ns, 1.0, 2.0, COVARIANCE_2, COVARIANCE_2)
            return encode_help(fix)
        case topics.STATUS:
            flows = (Flow("fix", target, 1, 42), Flow("belief", "", 0, 0, 0, 0, 4))
            status = Status(speaker, "1", now_ns, 0.1, 0.02, 3, "", {"odometry": 7}, 1, 20, 2, 40)
            return encode(msgspec.structs.replace(status, sent=flows))
        case topics.TRACK:
            return encode(Track(speaker, now_ns, 1.0, 2.0, 0.5, COVARIANCE_3, 3))
        case topics.POSE:
            rows = ((0.04, 0.01, 0.0), (0.01, 0.09, 0.0), (0.0, 0.0, 0.01))
            return encode(Pose(speaker, now_ns, 1.0, 2.0, 0.5, rows))
        case topics.IN_ODOMETRY:
            return encode(Odometry(now_ns - 100_000_000, now_ns, 0.05, 0.01))
        case topics.IN_SIGHTINGS:
            return encode(Sightings(now_ns, (Sighting(speaker, 2.0, 0.1), Sighting("oak", 3.0))))
        case topics.IN_POSITION:
            return encode(Position(now_ns, 1.0, 2.0, COVARIANCE_2))
        case topics.IN_INITIAL_POSE:
            return encode(InitialPose(now_ns, 1.0, 2.0, 0.5, COVARIANCE_3))
        case topics.IN_FRAME:
            return encode(Frame(now_ns, b"a picture"))
        case topics.LOOK:
            return encode(
                AnnotatedFrame(speaker, now_ns, b"a picture", (Sighting(target, 2.0, 0.1),))
            )
        case topics.DRIVE:
            return encode(Drive(speaker, now_ns, 0.5, 0.1))
        case topics.JOIN:
            return encode(Join(speaker, "1", now_ns))
        case topics.TRUTH:
            return encode(Truths(now_ns, (Truth(speaker, 1.0, 2.0, 0.5, 1),)))
    raise ValueError(f"{topic.key}: carries no payload")


def mixed_payloads(
    count: int, original: Callable[[], bytes], examples: Sequence[bytes], generator: random.Random
) -> Iterator[bytes]:
    """`count` payloads: a third of them from `examples`, a third random, a third damaged."""
    makers = (
        lambda: generator.choice(examples),
        lambda: random_payload(generator),
        lambda: damaged_payload(original(), generator),
    )
    for n in range(count):
        yield makers[n % len(makers)]()


def random_payload(generator: random.Random) -> bytes:
    """Random bytes; half of these payloads begin as a message does, binary or JSON."""
    head = generator.choice((bytes([VERSION]), b'{"stamp_ns":', b"", b""))
    return head + generator.randbytes(generator.randrange(LONGEST))


def damaged_payload(payload: bytes, generator: random.Random) -> bytes:
    """A payload with some bytes changed, cut off or appended, or with its content twice."""
    data = bytearray(payload)
    match generator.randrange(4):
        case 0:
            for _ in range(generator.randrange(1, 4)):
                data[generator.randrange(len(data))] = generator.randrange(256)
        case 1:
            del data[generator.randrange(len(data)) :]
        case 2:
            data += generator.randbytes(generator.randrange(1, 20))
        case 3:
            data += payload[1:]
    return bytes(data)


def hypothesis_payloads(seed: int) -> tuple[bytes, ...]:
    """Payloads that hypothesis generates: bytes, and lists with the tag of a message in front."""
    import hypothesis
    from hypothesis import strategies as st

    atoms = (
        st.none()
        | st.booleans()
        | st.integers(-(2**63), 2**64 - 1)
        | st.floats()
        | st.text(max_size=20)
        | st.binary(max_size=20)
    )
    names: st.SearchStrategy[Any] = st.text(max_size=8)
    anything = st.recursive(
        atoms,
        lambda inner: st.lists(inner, max_size=8) | st.dictionaries(names, inner, max_size=4),
        max_leaves=20,
    )
    tagged = st.builds(
        lambda tag, rest: bytes([VERSION]) + _encode([tag, *rest]),
        st.sampled_from(TAGS),
        st.lists(anything, max_size=16),
    )
    examples: list[bytes] = []

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=DISTINCT,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(st.binary(max_size=LONGEST) | tagged)
    def make(payload: bytes) -> None:
        examples.append(payload)

    make()
    return tuple(examples)
