"""ROS 2's own serialization and its own type hashes, from its wheels (Fast DDS)."""

import json
import random
from pathlib import Path

import pytest
from support.ros2_messages import plain, random_message, same
from support.ros2_partners import (
    HUMBLES,
    NOT_IN_WHEELS,
    run_partner,
    type_hash_in,
    wheels,
    write_prefix,
)

from cpcbl_transport.ros2.messages import MESSAGE_TYPES, MessageTypes, PayloadRefusal
from cpcbl_transport.ros2.names import Distribution

pytestmark = pytest.mark.ros2
TYPES = MessageTypes(Distribution.KILTED)
EACH = 1000
IN_WHEELS = [name for name in MESSAGE_TYPES if name not in NOT_IN_WHEELS]
WITH_PARTS = [*IN_WHEELS, "geometry_msgs/msg/TransformStamped"]  # what a TFMessage consists of


def test_fast_dds_reads_what_is_written_and_the_reverse(tmp_path: Path) -> None:
    """Every value is equal to the last bit, both ways. Bytes may differ where they mean nothing:
    in padding."""
    rng = random.Random(20)
    sent = {}
    for name in WITH_PARTS:
        package, _, short = name.split("/")
        for number in range(EACH):
            path = tmp_path / f"{package}.{short}.{number}.cdr"
            message = random_message(TYPES, name, rng)
            path.write_bytes(TYPES.encode(message))
            sent[path] = name, plain(message)
    run_partner("rclpy_partner.py", tmp_path)
    for path, (name, values) in sent.items():
        assert same(json.loads(path.with_suffix(".json").read_text()), values), name
        payload = path.with_suffix(".out").read_bytes()
        assert len(payload) == path.stat().st_size, name
        message = TYPES.decode(name, payload, TYPES.type_hash(name))
        assert not isinstance(message, PayloadRefusal), name
        assert same(plain(message), values), name


@pytest.mark.parametrize("name", IN_WHEELS)
def test_type_hashes_are_those_of_the_wheels(name: str) -> None:
    assert TYPES.type_hash(name) == type_hash_in(wheels(), name)


def test_type_hashes_of_other_packages_are_those_of_ros_2s_generator(tmp_path: Path) -> None:
    write_prefix(tmp_path, Distribution.HUMBLE)
    for name in NOT_IN_WHEELS:
        assert TYPES.type_hash(name) == type_hash_in(tmp_path, name)
    for name in HUMBLES:
        assert type_hash_in(tmp_path, name) in TYPES.readable_hashes(name) - {TYPES.type_hash(name)}
