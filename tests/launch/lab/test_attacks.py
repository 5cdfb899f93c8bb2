"""Observers that lie on purpose to one robot: the second part of `experiment liars`."""

from collections.abc import Sequence
from typing import NamedTuple

import pytest
from msgspec.structs import replace
from rich.console import Console
from support.quarantine_use import QuarantineUse, watched_quarantines

from cpcbl_launch.lab.experiments import attacks
from cpcbl_launch.lab.experiments.attacks import Attack, AttackRow, attack_rows, run_attack
from cpcbl_launch.lab.lying_observer import USUAL_HZ

EVERY = {(attack.name, attack.victim): attack for attack in attacks.attacks()}
SHORT = [
    *(("drift", "scout"), ("headings", "navigator"), ("no majority", "scout")),
    ("one axis", "scout"),
]
SHORT_S = 30.0

pytestmark = pytest.mark.timeout(300)


def rows_of(chosen: Sequence[Attack], seeds: Sequence[int]) -> tuple[AttackRow, ...]:
    cases = attacks.with_bases(chosen)
    return attack_rows({case: [run_attack(case, seed) for seed in seeds] for case in cases})


class Short(NamedTuple):
    """The short attacks and the runs to compare with."""

    rows: dict[tuple[str, str], AttackRow]
    quarantines: QuarantineUse


@pytest.fixture(scope="module")
def runs() -> Short:
    with watched_quarantines() as quarantines:
        rows = rows_of([replace(EVERY[key], end_s=SHORT_S) for key in SHORT], [2])
    return Short({(row.attack.name, row.attack.victim): row for row in rows}, quarantines)


@pytest.fixture(scope="module")
def short(runs: Short) -> dict[tuple[str, str], AttackRow]:
    return runs.rows


@pytest.mark.thorough
def test_nothing_is_used_of_a_liar_that_is_in_quarantine(runs: Short) -> None:
    """Its weight is so small by then that the figures hardly tell."""
    assert runs.quarantines.heard == {*attacks.TWO}
    assert runs.quarantines.used == set()


@pytest.mark.thorough
@pytest.mark.parametrize("key", SHORT[:2])
def test_an_attack_is_noticed_and_does_little_harm(
    short: dict[tuple[str, str], AttackRow], key: tuple[str, str]
) -> None:
    row = short[key]
    assert row.held
    assert row.attack.most_ratio is not None
    assert row.worst_ratio <= row.attack.most_ratio
    assert row.noticed_after_s is not None
    assert row.noticed_after_s < 20.0
    assert row.least_inside_3_sigma > 0.9
    assert row.worst_nees < 4.0
    assert row.false_quarantines == 0


@pytest.mark.thorough
def test_without_a_majority_the_robot_says_so_and_its_sigma_holds(
    short: dict[tuple[str, str], AttackRow],
) -> None:
    row = short["no majority", "scout"]
    assert row.noticed == 1
    assert row.least_inside_3_sigma > attacks.LEAST_INSIDE
    assert row.worst_ratio > 1.3  # nobody could find out


@pytest.mark.thorough
def test_one_that_is_certain_along_one_axis_only_leads_nobody_astray(
    short: dict[tuple[str, str], AttackRow],
) -> None:
    """It was too vague to be compared with others, and had weight all the same."""
    row = short["one axis", "scout"]
    assert row.held
    assert row.worst_ratio < 1.2  # 6.5 before, with a correct observer in quarantine
    assert row.false_quarantines == 0


def test_a_guest_of_ever_new_names_leads_nobody_astray_beside_one_correct_observer() -> None:
    """Each new name was used before anybody could have contradicted it."""
    attack = replace(EVERY["new names, one robot", "scout"], liars=attacks.GUEST, end_s=24.0)
    _, row = rows_of([attack], [1])
    assert row.noticed == 1
    assert row.worst_ratio < 1.2  # 4.6 before
    assert row.least_inside_3_sigma > 0.99  # 96 % before
    assert row.false_quarantines == 0


@pytest.mark.thorough
def test_those_who_echo_its_own_pose_lead_no_robot_with_eyes_astray() -> None:
    """They kept the estimate back along an axis that the present landmark did not measure, faster
    than the means of some seconds could tell: both correct observers came into quarantine."""
    attack = replace(EVERY["echo", "navigator"], end_s=24.0)
    _, row = rows_of([attack], [7])
    assert row.noticed == 1
    assert row.worst_ratio < 1.6  # 9.8 before
    assert row.least_inside_3_sigma > 0.9  # 73 % before
    assert row.false_quarantines == 0


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1, 10])
def test_an_echo_leads_no_blind_robot_astray_beside_two_correct_observers(seed: int) -> None:
    """It held the estimate back for half a second. One correct observer was too vague to say so,
    counted as one that agrees, and the other one came into quarantine (ratios of 3.0 and 4.6)."""
    attack = replace(EVERY["echo", "scout"], end_s=40.0)
    _, row = rows_of([attack], [seed])
    assert row.worst_ratio < attacks.BLIND_RATIO
    assert row.false_quarantines == 0
    assert row.least_inside_3_sigma > 0.97


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [2, 5])
def test_an_echo_that_amplifies_leads_no_blind_robot_astray(seed: int) -> None:
    """It pulled the estimate away as fast as its own error grew: up to 27.9 times the error, with a
    correct observer in quarantine in six of eight seeds."""
    attack = replace(EVERY["amplified echo", "scout"], end_s=40.0)
    _, row = rows_of([attack], [seed])
    assert row.worst_ratio < 1.8
    assert row.false_quarantines == 0
    assert row.least_inside_3_sigma > 0.93


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["drift", "overclaimed"])
def test_liars_are_found_where_all_report_twice_a_second(name: str) -> None:
    """Means of what they say of the estimate found them late, and put correct observers into
    quarantine: ratios of 1.91 and 1.65, 84 and 79 % inside 3 sigma."""
    _, row = rows_of([EVERY[f"{name}, 2 Hz", "scout"]], [2])
    assert row.held
    assert row.worst_ratio < 1.3
    assert row.least_inside_3_sigma > 0.92
    assert row.false_quarantines == 0


@pytest.mark.thorough
def test_without_a_majority_sigma_holds_where_all_report_twice_a_second() -> None:
    _, row = rows_of([EVERY["no majority, 2 Hz", "scout"]], [1])
    assert row.noticed == 1
    assert row.least_inside_3_sigma > 0.9  # 78 % before
    assert row.false_quarantines == 0  # two in seeds 1 and 2 before


@pytest.mark.thorough
def test_a_fix_that_states_less_than_its_sensor_can_do_carries_no_robot_off() -> None:
    """Beside observers with a usual sensor a liar of a centimetre outweighed both: 69 % inside 3
    sigma, NEES 6.9."""
    _, row = rows_of([EVERY["overclaimed, 5 %", "scout"]], [1])
    assert row.held
    assert row.noticed == 1
    assert row.least_inside_3_sigma > 0.97
    assert row.false_quarantines == 0


@pytest.mark.thorough
def test_two_liars_are_no_majority_beside_observers_that_see_the_robot_in_turn() -> None:
    """Both correct ones were in quarantine, and nobody said so: 16 % inside 3 sigma, NEES 96."""
    _, row = rows_of([EVERY["no majority, 5 %", "scout"]], [1])
    assert row.held
    assert row.worst_nees < 3.0
    assert row.false_quarantines == 0


@pytest.mark.thorough
def test_the_runs_to_compare_with_have_no_liar(short: dict[tuple[str, str], AttackRow]) -> None:
    for key in (("", "scout"), ("", "navigator")):
        assert short[key].worst_ratio == 1.0
        assert short[key].noticed == short[key].false_quarantines == 0


@pytest.mark.thorough
def test_the_table_says_which_aims_are_missed(
    short: dict[tuple[str, str], AttackRow], capsys: pytest.CaptureFixture[str]
) -> None:
    console = Console(width=80)
    for held in (True, False):
        shown = [replace(row, held=held) for row in short.values()]
        for part in attacks.attack_tables(shown, 1):
            console.print(part)
    text = capsys.readouterr().out
    assert "no majority" in text
    assert "All aims are met." in text
    assert "The aim is missed for: no liar (scout)" in text
    assert "…" not in text
    assert all(len(line) <= 80 for line in text.splitlines())


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_every_aim_but_those_of_poor_eyes_holds_in_twenty_seeds() -> None:
    """Two liars of four mislead a navigator for some seconds (docs/attacks.md)."""
    usual = [a for a in attacks.attacks() if a.reports_hz == USUAL_HZ and a.has_good_observers]
    rows = rows_of(usual, range(3000, 3020))
    missed = [(row.attack.name, row.attack.victim) for row in rows if not row.held]
    missed_by_poor_eyes = {(name, "navigator") for name in ("drift", "overclaimed", "sleeper")}
    assert set(missed) <= missed_by_poor_eyes


@pytest.mark.long
@pytest.mark.parametrize("name", ["drift", "overclaimed"])
def test_two_liars_are_no_majority_while_a_correct_observer_does_not_see_the_navigator(
    name: str,
) -> None:
    (row,) = rows_of([EVERY[name, "navigator"]], [401])[1:]
    assert row.worst_ratio < 1.4  # 1.47 and 1.64 before
    assert row.least_inside_3_sigma > 0.97


@pytest.mark.thorough
def test_two_liars_of_four_mislead_no_robot_with_eyes_for_long() -> None:
    """Own readings decide between two sides that the estimate follows both."""
    _, row = rows_of([EVERY["overclaimed", "navigator"]], [1])
    assert row.worst_ratio < 1.4  # 1.57 before
    assert row.least_inside_3_sigma > 0.97
    assert row.false_quarantines == 0


@pytest.mark.thorough
def test_no_correct_observer_is_quarantined_for_what_own_eyes_see_along_another_axis() -> None:
    """In this seed the landmarks were off by two sigmas in y, where the liars say nothing."""
    run = run_attack(EVERY["one axis", "navigator"], 2)
    assert run.false_quarantines == 0
    assert run.score.nees is not None
    assert run.score.nees < 2.0  # it was 9.5
