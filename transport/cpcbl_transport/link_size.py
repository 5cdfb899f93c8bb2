"""The bytes of a message on a TCP link: its payload, and what Zenoh adds at most.

A put alone in its batch (several may share one) of up to 32 kB, by a declared publisher with
Zenoh's default priority, through sessions that `zenoh_bus` opened. TCP and IP add 66 bytes a
packet, which is not counted here.

    length 2 | frame 1, sequence number 2 | push 1, number of the key 1-2 | put 1, size 1-3

Keys get their numbers in the order in which a session declares them: 1 byte up to 127, 2 bytes up
to 16,383, which is all tiers of 1,000 robots. Measured: 9 bytes for fixes and beliefs below 128.
"""

_FIXED = 2 + 1 + 2 + 1 + 2 + 1


def sent_bytes(payload: int) -> int:
    """The most bytes on the sender's link, for a payload of so many bytes (fix or belief)."""
    return _FIXED + _number_bytes(payload) + payload


def received_bytes(payload: int, sender: str) -> int:
    """The most bytes on the link of a receiver that subscribed to all senders of a tier.

    What stands after a subscription's first wildcard travels as text: `/` and the sender's name.
    """
    return sent_bytes(payload) + 2 + len(sender)


def _number_bytes(number: int) -> int:
    return max(1, -(-number.bit_length() // 7))
