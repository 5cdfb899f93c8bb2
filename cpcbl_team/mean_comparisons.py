"""What the means of other sources say of that of one (`mean_offsets.py`): whether it is wrong, or
contested, and how wrong it may be."""

from collections.abc import Mapping
from typing import Final, NamedTuple

from cpcbl_team.mean_offsets import (
    CONFLICT,
    USUAL,
    MeanOffset,
    Means,
    bias_variance,
    contradicts,
    disagreement,
    lead,
)
from cpcbl_team.sender_records import NO_EVIDENCE, OWN_SENSORS

SURE_SIGMA_M: Final = 0.08  # own sensors that are less certain convict and doubt nobody alone
CONFLICT_OF_MOST: Final = 36.0
"""The same between own sensors and most senders, if these say the same: it is less likely that so
many are wrong than that own sensors err by chance."""
LEAD: Final = 7.0
"""Of two that contradict each other one is clearly nearer to a third source by this difference of
their chi-squares."""
LEAD_ON_MOST: Final = 14.0
"""The same if the other one says what most senders say."""
EVIDENCE: Final = 12.0  # of own readings, in place of both
EVIDENCE_ON_MOST: Final = 18.0
NEARER: Final = 2.0
"""Of two senders one is probably nearer to the robot's own sensors by this difference of their
chi-squares."""


class Comparison(NamedTuple):
    """What the means of other sources say of that of one."""

    bias_variance: float = 0.0  # m^2, that a report of it may have in common with all others of it
    is_wrong: bool = False
    is_contested: bool = False
    """It contradicts others, and there is no majority for either side."""
    is_confirmed: bool = False
    """At least one other source agrees, and no majority contradicts."""
    is_left_out: bool = False  # it is contested, and a rival is nearer to the robot's own sensors


def both(fast: Comparison, slow: Comparison) -> Comparison:
    """Both comparisons of one source, by its means of a short and of a long time. While it is
    contested the longer ones that tell so decide whether it is used, for own sensors are noisy."""
    contested = slow if slow.is_contested else fast
    is_contested = contested.is_contested
    return Comparison(
        contested.bias_variance if is_contested else max(fast.bias_variance, slow.bias_variance),
        fast.is_wrong or slow.is_wrong,
        is_contested,
        fast.is_confirmed and slow.is_confirmed,
        contested.is_left_out,
    )


def compared_with_own_sensors(
    mean: MeanOffset,
    own: MeanOffset | None,
    others: Means,
    heard: int = 0,
    behind: Mapping[str, float] = NO_EVIDENCE,
) -> Comparison:
    """A sender beside the robot's own sensors, which outweigh any number of others. Where this one
    and another contradict each other, they decide by which of both is clearly nearer to theirs.
    `heard`: how many senders were heard lately, with this one and those in quarantine.

    The bias of a sender is its distance from its doubters: own sensors that are sure, and every
    other sender that is not clearly farther from these. How many others agree with it does not
    matter. A contested sender is left out if a rival is nearer to the own sensors. `behind`: by how
    much more likely others make own readings, in place of that (`SenderRecord`).
    """
    leads = {n: 0.0 if own is None else lead(other, mean, own) for n, other in others.items()}
    leads |= {n: behind[n] for n in others if n in behind}
    rivals = [n for n, other in others.items() if contradicts(mean, other)]
    friends = [other for n, other in others.items() if n not in rivals]
    doubters = [other for n, other in others.items() if leads[n] >= -NEARER]
    of_own = behind.get(OWN_SENSORS, 0.0)
    is_sure = own is not None and own.is_within(SURE_SIGMA_M) and of_own >= -NEARER
    if own is not None and is_sure:
        doubters.append(own)
    bias = max((bias_variance(mean, doubter) for doubter in doubters), default=0.0)
    apart = disagreement(mean, own) if own is not None and is_sure else 0.0
    is_doubted = apart > CONFLICT
    number = max(heard, len(others) + 1)

    def is_of_most(like_it: int) -> bool:
        """Whether it and so many others, which own sensors are against as well, are most of all."""
        return like_it > 0 and 2 * (like_it + 1) > number

    like_it = 0 if own is None else sum(disagreement(f, own) > USUAL for f in friends)
    is_refuted = apart > CONFLICT_OF_MOST or (is_doubted and not is_of_most(like_it))
    is_behind = any(
        leads[n] > _bound(n in behind, is_of_most(sum(contradicts(others[n], f) for f in friends)))
        for n in rivals
    )
    if is_refuted or is_behind:
        return Comparison(bias, is_wrong=True)
    is_contested = any(leads[n] >= -_bound(n in behind) for n in rivals)
    is_left_out = any(leads[n] > NEARER for n in rivals if n not in behind)
    return Comparison(bias, False, is_contested, not (is_contested or is_doubted), is_left_out)


def _bound(has_evidence: bool, is_of_most: bool = False) -> float:
    """By how much a sender has to be behind another to be wrong: by evidence of own readings, or by
    the mean of own sensors; and if it says what most senders say."""
    if has_evidence:
        return EVIDENCE_ON_MOST if is_of_most else EVIDENCE
    return LEAD_ON_MOST if is_of_most else LEAD


def compared_with_majority(mean: MeanOffset, others: Means, heard: int = 0) -> Comparison:
    """A sender beside the others. The bias is the distance within which a strict majority of all
    agrees with it: with three, its own and one more; with four, its own and two more. It is wrong
    if the majority of all that were `heard` lately contradicts it: those of the moment may be the
    liars, while one that would agree with it does not see the robot."""
    count = len(others) + 1
    if count == 1:
        return Comparison()
    needed = count // 2  # other means that make a strict majority with its own
    apart = {name: disagreement(mean, other) for name, other in others.items()}
    biases = sorted([bias_variance(mean, other, apart=apart[n]) for n, other in others.items()])
    bias = biases[needed - 1]
    accusers = {n: other for n, other in others.items() if apart[n] > CONFLICT}
    if len(others) - len(accusers) >= needed:
        return Comparison(bias, is_confirmed=True)
    all_ = max(heard, count)
    is_wrong = any(2 * (_agreeing(name, accusers) + 1) > all_ for name in accusers)
    return Comparison(bias, is_wrong, not is_wrong)


def _agreeing(name: str, others: Means) -> int:
    """How many of the others agree with this one of them."""
    mean = others[name]
    return sum(not contradicts(mean, other) for n, other in others.items() if n != name)
