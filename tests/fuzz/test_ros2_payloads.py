"""Damaged CDR of ROS 2 and damaged attachments: a message or a reason, never an error, and no more
memory than a few times the payload.

`make fuzz` tries 100,000 payloads; `make test` a tenth of them.
"""

import random
import tracemalloc

import pytest
from support.ros2_messages import random_message

from cpcbl_transport.ros2.attachment import Attachment, decode_attachment
from cpcbl_transport.ros2.messages import MESSAGE_TYPES, MessageTypes, PayloadRefusal
from cpcbl_transport.ros2.names import Distribution

TYPES = MessageTypes(Distribution.JAZZY)
LENGTHS = (0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1)
LEAST_PEAK, PEAK_RATIO = 2_000_000, 100  # bytes; objects of Python are larger than their bytes


def damaged(payload: bytes, rng: random.Random) -> bytes:
    """A payload with bytes changed, a length written into it, cut, repeated, or quite another."""
    data = bytearray(payload)
    match rng.randrange(6):
        case 0:
            for _ in range(rng.randrange(1, 9)):
                data[rng.randrange(len(data))] = rng.randrange(256)
        case 1:
            place = 4 + 4 * rng.randrange(max(1, len(data) // 4 - 1))
            data[place : place + 4] = rng.choice(LENGTHS).to_bytes(4, "little")
        case 2:
            del data[rng.randrange(len(data)) :]
        case 3:
            data += data[rng.randrange(len(data)) :]
        case 4:
            data[4:] = rng.randbytes(rng.randrange(400))
        case 5:
            start = rng.randrange(len(data))
            del data[start : start + rng.randrange(1, 9)]
    return bytes(data)


@pytest.mark.parametrize("count", [10_000, pytest.param(100_000, marks=pytest.mark.long)])
def test_any_payload_is_a_message_or_has_a_reason(count: int) -> None:
    rng = random.Random(count)
    outcomes = set()
    for number in range(count):
        name = MESSAGE_TYPES[number % len(MESSAGE_TYPES)]
        if number % (50 * len(MESSAGE_TYPES)) < len(MESSAGE_TYPES):
            whole = {n: TYPES.encode(random_message(TYPES, n, rng)) for n in MESSAGE_TYPES}
        decoded = TYPES.decode(name, damaged(whole[name], rng))
        outcomes.add(str(decoded) if isinstance(decoded, PayloadRefusal) else "message")
    assert outcomes == {"message", "cut_short", "too_long", "no_cdr", "bad_text"}


def test_no_payload_takes_much_memory() -> None:
    rng = random.Random(23)
    for number in range(600):
        name = MESSAGE_TYPES[number % len(MESSAGE_TYPES)]
        payload = damaged(TYPES.encode(random_message(TYPES, name, rng)), rng)
        tracemalloc.start()
        TYPES.decode(name, payload)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < max(LEAST_PEAK, PEAK_RATIO * len(payload)), (name, payload)


def test_any_attachment_is_read_or_refused() -> None:
    rng = random.Random(24)
    for _ in range(10_000):
        attachment = decode_attachment(rng.randbytes(rng.choice((0, 16, 32, 33, 33, 33, 34, 80))))
        assert attachment is None or isinstance(attachment, Attachment)
