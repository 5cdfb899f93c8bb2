"""What reports say of the offset of the estimate, where that is vague itself."""

import pytest
from support.core import SECOND, diagonal, state_at

from cpcbl_team.estimate import Information
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.mean_offsets import (
    FAST_NS,
    NOTHING,
    FadingOffsets,
    MeanOffset,
    contradicts,
)
from cpcbl_team.offset_evidence import CHANGING_M2, VAGUE_M2, evidence_at
from cpcbl_team.sender_records import Rival, SenderRecord
from cpcbl_team.state import State, with_teammates

ORIGIN = Pose2(0.0, 0.0, 0.0)
EXACT_M = 0.01  # sigma of a report


def state_of(sigma_m: float, *, is_contested: bool = False) -> State:
    """A state with this sigma of each axis, and perhaps two senders in a contest."""
    state = state_at(ORIGIN, diagonal(sigma_m, 0.05))
    a, b = Rival("b", 1.0, 0.0), Rival("a", -1.0, 0.0)
    senders = {"a": SenderRecord(rivals=(a,)), "b": SenderRecord(rivals=(b,))}
    teammates = state.memory.teammates._replace(senders=senders if is_contested else {})
    return with_teammates(state, teammates)


def changing_m2(state: State) -> float:
    """How much of the variance (xx + yy) of this estimate counts as noise of an exact report."""
    rows = ((1.0, 0.0, 0.0), 0.0, EXACT_M**2), ((0.0, 1.0, 0.0), 0.0, EXACT_M**2)
    (xx, _, yy, *_), _ = evidence_at(state, Information.none().with_all(rows)).evidence
    return 1.0 / xx + 1.0 / yy - 2.0 * EXACT_M**2


@pytest.mark.parametrize("sigma_m", [0.01, 0.03, 0.1, 0.14])
def test_only_a_part_of_the_variance_of_a_usual_estimate_changes_between_reports(
    sigma_m: float,
) -> None:
    assert changing_m2(state_of(sigma_m)) == pytest.approx(min(2.0 * sigma_m**2, CHANGING_M2))


@pytest.mark.parametrize("sigma_m", [0.2, 0.5, 1.5])
def test_a_report_corrects_a_vague_estimate_but_in_a_contest(sigma_m: float) -> None:
    expected = CHANGING_M2 + 2.0 * sigma_m**2 - VAGUE_M2
    assert changing_m2(state_of(sigma_m)) == pytest.approx(expected)
    assert changing_m2(state_of(sigma_m, is_contested=True)) == pytest.approx(CHANGING_M2)


def test_whoever_corrected_a_vague_estimate_is_no_liar_afterwards() -> None:
    """The first report is off by 0.9 m from the estimate, which did not know better, and those
    after it agree with the estimate, but hardly tell along that axis."""
    sums = FadingOffsets()
    for i in range(6):
        estimate, sigma_m, x = (state_of(1.5), 0.1, 0.9) if i == 0 else (state_of(0.03), 0.5, 0.0)
        rows = ((1.0, 0.0, 0.0), x, sigma_m**2), ((0.0, 1.0, 0.0), 0.0, EXACT_M**2)
        evidence = evidence_at(estimate, Information.none().with_all(rows)).evidence
        sums = sums.with_report(i * SECOND // 10, FAST_NS, evidence, NOTHING)
    mean = sums.mean(0.01)
    assert mean is not None
    own = MeanOffset(0.0, 0.0, Covariance2(1e-4, 0.0, 1e-4))
    assert not contradicts(mean, own)
    assert abs(mean.x) < 0.1
