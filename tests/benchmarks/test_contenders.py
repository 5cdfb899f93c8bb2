"""What the benchmarks compare computes the same thing, and all of it. No times here."""

import math
from collections.abc import Sequence

import pytest
from benchmarks.contenders import ALL, OURS, PEERS
from benchmarks.drive import CYCLES, drive

from cpcbl_team.geometry import wrap_angle

DRIVE = drive()


def final_pose(name: str) -> Sequence[float]:
    contender = ALL[name]
    return contender.pose(contender.run(map(contender.reading, DRIVE)))


def apart(a: Sequence[float], b: Sequence[float]) -> tuple[float, float]:
    """(metres, radians)"""
    return math.hypot(a[0] - b[0], a[1] - b[1]), abs(wrap_angle(float(a[2] - b[2])))


# What is linearized at the prior is the same filter; the rest differs by how it linearizes,
# and the particle filter by chance.
@pytest.mark.parametrize(
    ("name", "metres", "radians"),
    [
        ("float EKF, solved once", 1e-9, 1e-9),
        ("float EKF, with gates", 1e-9, 1e-9),
        ("numpy EKF", 1e-9, 1e-9),
        ("filterpy EKF", 1e-9, 1e-9),
        ("float EKF", 1e-3, 1e-3),
        ("GTSAM EKF", 1e-3, 1e-3),
        ("particle filter, 500", 0.03, 0.02),
    ],
)
def test_peers_agree_with_joint(name: str, metres: float, radians: float) -> None:
    if name not in PEERS:
        pytest.skip("needs the extra: pip install '.[bench]'")
    position, heading = apart(final_pose(name), final_pose("joint"))
    assert position < metres
    assert heading < radians


@pytest.mark.parametrize("name", ALL)
def test_the_drive_is_followed(name: str) -> None:
    position, heading = apart(final_pose(name), DRIVE[-1].truth)
    assert position < 0.1
    assert heading < 0.05


@pytest.mark.parametrize("name", OURS)
def test_every_update_of_the_localizer_really_happens(name: str) -> None:
    contender = OURS[name]
    state = contender.run(map(contender.reading, DRIVE))
    assert dict(state.counts) == {"accepted": 4 * CYCLES}
    assert not state.lost


def test_every_update_of_the_gated_peer_really_happens() -> None:
    contender = PEERS["float EKF, with gates"]
    watched = contender.run(map(contender.reading, DRIVE))
    assert watched.counts == {"accepted": 4 * CYCLES, "gated": 0}
