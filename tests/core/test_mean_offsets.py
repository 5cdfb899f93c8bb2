"""The mean of what a source reports, and what the means of several sources say of each other."""

import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpcbl_team.estimate import Covariance3, Information
from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_comparisons import (
    LEAD,
    Comparison,
    both,
    compared_with_majority,
    compared_with_own_sensors,
)
from cpcbl_team.mean_offsets import (
    CONFLICT,
    NOTHING,
    SLOW_NS,
    FadingOffsets,
    MeanOffset,
    bias_variance,
    by_whole_noise,
    disagreement,
    lead,
    with_heading_error,
    with_position_error,
)

SECOND = 1_000_000_000
FADING_NS = 2 * SECOND
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
SHARP = Covariance2(1e-4, 0.0, 1e-4)


def at(x: float, y: float = 0.0, sigma: float = 0.01) -> MeanOffset:
    return MeanOffset(x, y, Covariance2(sigma * sigma, 0.0, sigma * sigma))


def summed(offsets: list[tuple[float, float]], dependent: Covariance2 = NOTHING) -> FadingOffsets:
    """Reports of 1 cm, ten times a second."""
    sums = FadingOffsets()
    for i, offset in enumerate(offsets):
        evidence = Observation(AXES, offset, SHARP, NOTHING).information(SHARP)
        sums = sums.with_report(i * SECOND // 10, FADING_NS, *by_whole_noise(evidence, dependent))
    return sums


def test_the_mean_of_equal_reports_is_the_report_and_gets_sharper_than_one() -> None:
    mean = summed([(0.3, -0.2)] * 300).mean(0.01)
    assert mean is not None
    assert (mean.x, mean.y) == pytest.approx((0.3, -0.2))
    # exp(-0.1 s / 2 s) = f: the variance of the weighted mean is (1 - f) / (1 + f) of one report's
    assert mean.covariance.xx == pytest.approx(1e-4 * math.tanh(0.025), rel=0.01)


def test_few_reports_have_no_mean() -> None:
    assert summed([(0.0, 0.0)] * 4).mean(0.01) is None
    assert summed([(0.0, 0.0)] * 6).mean(0.01) is not None


def test_the_dependent_part_of_the_noise_does_not_average_away() -> None:
    mean = summed([(0.0, 0.0)] * 100, Covariance2(0.04, 0.01, 0.09)).mean(0.01)
    assert mean is not None
    assert mean.covariance.xx == pytest.approx(0.04, rel=0.01)
    assert mean.covariance.xy == pytest.approx(0.01, rel=0.01)
    assert mean.covariance.yy == pytest.approx(0.09, rel=0.01)


def test_the_stated_variance_of_a_mean_is_that_of_many_runs() -> None:
    dice, squares, stated = random.Random(1), [], 0.0
    for _ in range(200):
        offsets = [(dice.gauss(0.0, 0.01), dice.gauss(0.0, 0.01)) for _ in range(80)]
        mean = summed(offsets).mean(0.01)
        assert mean is not None
        squares.append(mean.x**2 + mean.y**2)
        stated = mean.covariance.xx + mean.covariance.yy
    assert sum(squares) / len(squares) == pytest.approx(stated, rel=0.2)


def test_one_direction_alone_determines_no_mean() -> None:
    sums = FadingOffsets()
    for i in range(50):
        row = Information.none().add((1.0, 0.0, 0.0), 0.1, 1e-4)
        sums = sums.with_report(i * SECOND // 10, FADING_NS, row)
    assert sums.mean(0.01) is None


def test_what_depends_on_the_heading_counts_as_little_as_the_heading_is_known() -> None:
    sums = FadingOffsets()
    for i in range(50):
        both = Information.none().add((1.0, 0.0, 0.0), 0.0, 1e-4).add((0.0, 0.2, 1.0), 0.0, 1e-4)
        sums = sums.with_report(i * SECOND // 10, FADING_NS, both)
    mean = sums.mean(math.radians(10.0) ** 2)
    assert mean is not None
    assert mean.covariance.xx < 0.01**2
    assert mean.covariance.yy > (5.0 * math.radians(10.0)) ** 2 / 4.0  # 1 m across is 0.2 rad


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.005, 0.1), st.floats(-1.0, 1.0))
def test_the_error_of_the_estimate_changes_no_comparison(
    x: float, y: float, sigma: float, common: float
) -> None:
    one, other = at(x, 0.1, sigma), at(0.2, y, sigma)
    moved = [m._replace(x=m.x + common, y=m.y - common) for m in (one, other)]
    assert disagreement(*moved) == pytest.approx(disagreement(one, other), abs=1e-6)
    assert bias_variance(*moved) == pytest.approx(bias_variance(one, other), abs=1e-9)
    assert disagreement(one, other) == pytest.approx(disagreement(other, one))


def test_a_difference_within_the_noise_is_no_bias() -> None:
    assert bias_variance(at(0.0), at(0.015)) == 0.0
    assert bias_variance(at(0.0), at(0.1)) == pytest.approx(0.1**2 - 4e-4)


def test_the_bias_of_one_that_is_vague_along_one_axis_is_that_along_the_other() -> None:
    thin = at(0.1)._replace(covariance=Covariance2(1e-4, 0.0, 0.09))
    assert bias_variance(at(0.0), thin) == pytest.approx(0.1**2 - 4e-4, abs=1e-4)
    assert bias_variance(at(0.0), thin._replace(x=0.0, y=0.5)) == 0.0


@given(st.floats(0.0, 0.5), st.floats(0.01, 0.3), st.floats(-math.pi, math.pi))
def test_a_bias_is_no_longer_than_the_difference_and_turns_with_it(
    length: float, sigma: float, angle: float
) -> None:
    def turned(by: float) -> MeanOffset:
        covariance = Covariance2(1e-4, 0.0, sigma * sigma).rotated(by)
        return MeanOffset(length * math.cos(1.0 + by), length * math.sin(1.0 + by), covariance)

    bias = bias_variance(at(0.0), turned(0.0))
    assert bias <= length * length
    assert bias == pytest.approx(bias_variance(at(0.0), turned(angle)), rel=1e-6, abs=1e-9)


def test_the_error_of_the_position_is_added_to_the_noise() -> None:
    """Against the general form: the inverse of the matrix grows by the covariance."""
    random_ = np.random.default_rng(2)
    root = random_.normal(size=(4, 3))
    matrix, offset = root.T @ root, random_.normal(size=3)
    added = np.zeros((3, 3))
    added[:2, :2] = [[0.3, 0.1], [0.1, 0.2]]
    due = np.linalg.inv(np.linalg.inv(matrix) + added)
    order = (0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)
    sums = Covariance3(*(float(matrix[i]) for i in order)), tuple((matrix @ offset).tolist())
    found, vector = with_position_error(sums, Covariance2(0.3, 0.1, 0.2))
    assert found == pytest.approx([due[i] for i in order])
    assert vector == pytest.approx(due @ offset)
    assert with_position_error(sums, NOTHING) == sums


@pytest.mark.parametrize("seed", range(5))
def test_ranges_to_one_that_is_followed_do_not_meet_far_from_all_of_them(seed: int) -> None:
    """Precise along lines that are nearly parallel, while the estimate moves by centimetres."""
    dice, sums, raw = random.Random(seed), FadingOffsets(), FadingOffsets()
    error = Covariance2(0.03**2, 0.0, 0.03**2)
    for i in range(40):
        ahead, moved = 2.7 + 0.002 * i, 0.03 * math.sin(0.4 * i) + dice.gauss(0.0, 0.01)
        c, s = math.cos(ahead), math.sin(ahead)
        report = Information.none().add((c, s, 0.0), c * moved, 0.002**2)
        report = report.add((-s, c, 0.0), -s * moved, 0.11**2)
        raw = raw.with_report(i * SECOND // 10, FADING_NS, report)
        sums = sums.with_report(i * SECOND // 10, FADING_NS, with_position_error(report, error))
    mean, without = sums.mean(0.01), raw.mean(0.01)
    assert mean is not None
    assert without is not None
    assert mean.covariance.mahalanobis_squared(mean.x, mean.y) < 9.0
    assert without.covariance.mahalanobis_squared(without.x, without.y) > 13.8  # without it


# Comparisons --------------------------------------------------------------------------------------


def results(*means: MeanOffset) -> list[str]:
    """What all others say of each."""
    found = []
    for i, mean in enumerate(means):
        others = {str(j): other for j, other in enumerate(means) if j != i}
        comparison = compared_with_majority(mean, others)
        word = (
            "wrong" if comparison.is_wrong else "contested" if comparison.is_contested else "right"
        )
        found.append(word)
    return found


def test_a_strict_majority_convicts_and_half_does_not() -> None:
    assert results(at(0.0), at(0.01), at(0.5)) == ["right", "right", "wrong"]
    assert results(at(0.0), at(0.5)) == ["contested", "contested"]
    assert results(at(0.0), at(0.0), at(0.5), at(0.5)) == ["contested"] * 4
    assert results(at(0.0), at(0.0), at(0.0), at(0.5), at(0.5)) == ["right"] * 3 + ["wrong"] * 2
    assert results(at(0.0)) == ["right"]


def test_those_of_the_moment_convict_nobody_against_most_that_were_heard_lately() -> None:
    """Two liars beside one correct sender, while the other correct one does not see the robot."""
    correct, others = at(0.5), {"a": at(0.0), "b": at(0.0)}
    for heard, is_wrong in ((0, True), (3, True), (4, False)):
        comparison = compared_with_majority(correct, others, heard)
        assert (comparison.is_wrong, comparison.is_contested) == (is_wrong, not is_wrong)
    assert compared_with_majority(at(0.0), {"a": at(0.0), "b": correct}, 4).is_confirmed


def test_three_that_all_disagree_convict_nobody() -> None:
    assert results(at(0.0), at(0.5), at(1.0)) == ["contested"] * 3


def test_one_that_agrees_with_both_sides_is_no_accuser_of_either() -> None:
    vague = at(0.05, sigma=0.03)
    assert disagreement(vague, at(0.0)) < CONFLICT > disagreement(vague, at(0.1))
    words = results(at(0.0), at(0.1), at(0.1), vague)
    assert words[0] == "contested"  # two accusers of four are no majority


def test_the_bias_is_the_distance_to_a_strict_majority() -> None:
    honest, liar = at(0.0), at(0.1)
    of_liar = compared_with_majority(liar, {"a": honest, "b": honest}).bias_variance
    assert of_liar == pytest.approx(0.1**2 - 4e-4)
    assert compared_with_majority(honest, {"a": honest, "b": liar}).bias_variance == 0.0
    two_each = compared_with_majority(honest, {"a": honest, "b": liar, "c": liar})
    assert two_each.bias_variance == of_liar


@given(st.permutations(range(5)))
def test_the_order_of_the_senders_does_not_matter(order: list[int]) -> None:
    means = [at(0.0), at(0.02), at(0.3), at(0.31), at(0.01)]
    words = results(*means)
    assert results(*(means[i] for i in order)) == [words[i] for i in order]


def test_own_sensors_outweigh_any_number_of_means() -> None:
    own, liars = at(0.0, sigma=0.03), {str(i): at(0.5) for i in range(9)}
    assert compared_with_own_sensors(at(0.5), own, liars).is_wrong
    assert not compared_with_own_sensors(at(0.0), own, liars).is_wrong
    assert not compared_with_own_sensors(at(0.0), own, liars).is_contested


def test_vague_own_sensors_convict_only_one_of_two_that_contradict_each_other() -> None:
    own = at(0.0, sigma=0.1)
    assert not compared_with_own_sensors(at(0.6), own, {}).is_wrong
    assert compared_with_own_sensors(at(0.6), own, {"a": at(0.0)}).is_wrong
    undecided = compared_with_own_sensors(at(0.1), own, {"a": at(0.0)})
    assert undecided.is_contested
    assert not undecided.is_left_out  # its bias bounds its weight
    assert undecided.bias_variance == pytest.approx(0.1**2 - 4e-4)
    assert not undecided.is_wrong


def test_without_a_decision_of_own_sensors_even_a_majority_is_as_biased_as_it_is_far_off() -> None:
    own, honest, liar = at(0.0, sigma=0.1), at(0.0), at(0.06)
    lying = compared_with_own_sensors(liar, own, {"a": liar, "b": liar, "c": honest})
    right = compared_with_own_sensors(honest, own, {"a": liar, "b": liar, "c": liar})
    assert lying.bias_variance == right.bias_variance == pytest.approx(0.06**2 - 4e-4)
    nearer = compared_with_own_sensors(honest, at(0.0, sigma=0.02), {"a": liar, "b": liar})
    assert nearer.bias_variance == 0.0


def one_axis(x: float, y: float = 0.0) -> MeanOffset:
    """A source that states 8 mm in x and 25 cm in y."""
    return MeanOffset(x, y, Covariance2(0.008**2, 0.0, 0.25**2))


def test_an_error_of_own_sensors_where_a_liar_says_nothing_is_no_point_for_it() -> None:
    """Figures of the attack `one axis` in seed 2: own landmarks were off by two sigmas in y, where
    only the correct source is certain. In x they were nearer to the liar, but not clearly."""
    own = MeanOffset(0.103, -0.176, Covariance2(0.048**2, 0.0, 0.084**2))
    honest, liar = at(-0.034, -0.013), one_axis(0.075, -0.008)
    assert disagreement(honest, own) - disagreement(liar, own) > LEAD
    right = compared_with_own_sensors(honest, own, {"a": liar})
    assert right.is_contested
    assert not right.is_wrong


def test_own_sensors_convict_one_that_is_certain_along_one_axis_by_that_axis() -> None:
    own = MeanOffset(0.0, -0.19, Covariance2(0.02**2, 0.0, 0.084**2))
    honest, liar = at(0.0, 0.0, sigma=0.014), one_axis(0.1)
    assert compared_with_own_sensors(liar, own, {"a": honest}).is_wrong
    assert not compared_with_own_sensors(honest, own, {"a": liar}).is_wrong


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_lead_depends_on_the_axis_of_the_contradiction_only(x: float, y: float, z: float) -> None:
    one, other = at(x), one_axis(0.1)
    ahead = lead(one, other, at(0.03, y, sigma=0.04))
    assert ahead == pytest.approx(-lead(other, one, at(0.03, y, sigma=0.04)))
    assert ahead == pytest.approx(lead(one, other, at(0.03, z, sigma=0.04)))


def test_sources_at_the_same_place_have_no_lead() -> None:
    assert lead(at(0.1), at(0.1), at(0.0)) == 0.0


def test_vague_own_sensors_lower_the_weight_of_nobody_alone() -> None:
    assert compared_with_own_sensors(at(0.3), at(0.0, sigma=0.1), {}).bias_variance == 0.0
    assert compared_with_own_sensors(at(0.2), at(0.0, sigma=0.07), {}).bias_variance > 0.0


def test_a_contested_source_is_used_while_own_sensors_are_nearer_to_it_than_to_its_rivals() -> None:
    """Before these decide: the bias counts against own sensors only, not against the rivals."""
    own, honest, liar = at(0.0, sigma=0.04), at(0.0), at(0.09)
    right = compared_with_own_sensors(honest, own, {"a": liar, "b": liar, "c": honest})
    lying = compared_with_own_sensors(liar, own, {"a": honest, "b": liar, "c": honest})
    assert right.is_contested
    assert not right.is_left_out
    assert right.bias_variance == 0.0
    assert lying.is_contested
    assert lying.is_left_out
    assert not lying.is_wrong


def test_of_a_contested_source_the_longer_mean_decides_whether_it_is_used() -> None:
    fast = Comparison(0.04, is_contested=True, is_left_out=True)
    slow = Comparison(0.01, is_contested=True)
    assert not both(fast, slow).is_left_out
    assert both(fast, slow).bias_variance == 0.01
    assert both(fast, Comparison(0.01)).is_left_out  # the slow one says nothing yet
    assert both(Comparison(0.01), Comparison(0.04)).bias_variance == 0.04


@pytest.mark.parametrize(
    ("silent_s", "sigma_m", "is_wrong"),
    [
        (0.5, 0.06, False),
        (0.5, 0.01, True),
        (0.1, 0.06, True),
    ],
)
def test_what_odometry_changed_since_the_own_sensors_were_silent_is_nobodys_fault(
    silent_s: float, sigma_m: float, is_wrong: bool
) -> None:
    """The estimate became less certain while one source was silent, so its error may be another
    one. Sources whose reports alternate speak of the same error."""
    now_ns = 10 * SECOND
    own = at(0.0)._replace(stamp_ns=now_ns - round(silent_s * SECOND), estimate_variance=0.01**2)
    mate = at(0.09)._replace(stamp_ns=now_ns, estimate_variance=sigma_m**2)
    assert compared_with_own_sensors(mate, own, {}).is_wrong is is_wrong
    assert compared_with_own_sensors(own, mate, {}).is_wrong is is_wrong
    assert (bias_variance(mate, own) > 0.0) is is_wrong


def test_a_mean_knows_how_certain_the_estimate_was_at_its_last_report() -> None:
    mean = summed([(0.0, 0.0)] * 10).mean(0.01, estimate_variance=0.02)
    assert mean is not None
    assert (mean.stamp_ns, mean.estimate_variance) == (9 * SECOND // 10, 0.02)


def test_a_heading_that_errs_otherwise_in_each_frame_moves_no_mean() -> None:
    """Of a robot that turns: bearings of landmarks that it sees one after the other would tell of
    its place together only if its heading had one error in all frames."""
    dice, sigma, noise = random.Random(2), math.radians(5.0), math.radians(1.0)
    squares = []
    for _ in range(200):
        sums = FadingOffsets()
        for i in range(24):
            direction, turn = dice.uniform(-math.pi, math.pi), dice.gauss(0.0, sigma)
            c, s = math.cos(direction), math.sin(direction)  # of a landmark, 4 m away
            bearing = (-s / 4.0, c / 4.0, 1.0), turn + dice.gauss(0.0, noise), noise * noise
            distance = (c, s, 0.0), dice.gauss(0.0, 0.2), 0.04
            frame = with_heading_error(Information.none().with_all((bearing, distance)), sigma**2)
            sums = sums.with_report(i * SECOND // 2, SLOW_NS, frame)
        mean = sums.mean(sigma**2)
        assert mean is not None
        squares.append(mean.covariance.mahalanobis_squared(mean.x, mean.y))
    # a consistent mean has 2, or less where it is cautious; without the frames' errors it has 42
    assert 0.5 < sum(squares) / len(squares) < 2.2


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_an_error_of_the_heading_changes_no_evidence_without_bearings(x: float, y: float) -> None:
    evidence = Information.none().with_all((((1.0, 0.0, 0.0), x, 1e-4), ((0.6, 0.8, 0.0), y, 1e-4)))
    assert with_heading_error(evidence, 0.01) == evidence
