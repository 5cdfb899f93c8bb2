"""The net: a refactoring must not change a single bit of what the localizer computes.

Two recordings are compared with a stored reference: the localizer's state after every input of a
drive in which everything happens once (`scenario`), for ten configurations (`recording`), one of
them also on two other drives; and the tracks of all robots of the simulated demo for three seeds.
The reference has a hash of every state and some whole states, so that a failure can name the first
number that differs. It knows nothing of Python names: after a rename only `canonical` is edited.

The reference holds for CPython's mathematics on glibc, x86-64, with numpy's random numbers. On a
platform where these give other bits (a fingerprint is stored) the whole states are compared within
a relative error of 1e-9.

A change that is meant to move numbers renews the reference by `make net`, which prints what moved.
"""

import pytest
from net.recording import Recording, Run
from net.reference import KINDS, first_difference, read_reference, record

WHAT_HAPPENS = {
    "accepted",
    "distrusted",
    "found_again",
    "gated",
    "heading_gated",
    "impossible_duration",
    "lost",
    "not_finite",
    "odometry_gap",
    "odometry_overlap",
    "quarantined",
    "range_not_positive",
    "readmitted",
}
REASONS = {"biased", "frozen", "jumps", "overconfident"}  # "outvoted": core/test_trust.py


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_has_moved(kind: str) -> None:
    assert not (line := first_difference(read_reference(kind), record(kind))), line


def test_everything_happens_in_the_drive() -> None:
    """The reference holds every event that the localizer counts, and all kinds of senders."""
    runs = read_reference("states").runs.values()
    last = [run.kept[max(run.kept)] for run in runs]
    assert {event for state in last for event in state["counts"]} >= WHAT_HAPPENS
    states = [state for run in runs for state in run.kept.values()]
    senders = [item for state in states for item in state["trust"].items()]
    assert {sender["reason"] for _, sender in senders} >= REASONS
    assert {name for name, _ in senders} == {"own sensors", "ally", "liar", "mate"}
    moved = [state["self_calibration"]["distance_scale"][0] for state in last]
    assert sum(scale != 1.0 for scale in moved) == 1


def _recording(x: float, platform: str = "here", digest: str = "a") -> Recording:
    state = {"estimate": {"pose": [x, 0.0]}, "counts": {}}
    return Recording(platform, {"joint": Run([digest, digest], ["a fix", "a frame"], {1: state})})


def test_the_first_difference_is_named() -> None:
    line = first_difference(_recording(1.0), _recording(1.5, digest="b"))
    assert "joint: the states differ from step 0 (a fix) on" in line
    assert "of step 1, estimate.pose[0] was 1.0, is 1.5 (1 numbers differ, in: estimate)" in line


def test_every_bit_counts_on_the_platform_of_the_reference() -> None:
    assert first_difference(_recording(1.0), _recording(1.0 + 1e-15))
    assert first_difference(_recording(1.0), _recording(1.0, digest="b"))
    assert not first_difference(_recording(1.0), _recording(1.0))


def test_rounding_is_allowed_on_another_platform() -> None:
    assert not first_difference(_recording(1.0), _recording(1.0 + 1e-12, "elsewhere", "b"))
    assert first_difference(_recording(1.0), _recording(1.0 + 1e-8, "elsewhere", "b"))
