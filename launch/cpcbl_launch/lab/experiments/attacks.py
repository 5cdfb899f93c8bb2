"""Observers that lie on purpose to one driving robot, their victim: the second part of the
experiment `liars`.

The team is that of `liars.py`, with one driving robot and two correct observers. Each liar always
sees its victim (`lying_observer.py`). The victim is compared with itself in the run of the same
seed without liars, and judged by the worst seed: the aim holds in every one or not at all.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.trust_watch import TrustWatch
from cpcbl_launch.lab.faulty_robot import Fault
from cpcbl_launch.lab.lying_observer import USUAL_HZ, LyingObserver, RenamedLiar
from cpcbl_launch.reporting.metrics import Score, score
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.reporting.tables import number, table
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import robot_nodes, run_nodes
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import RobotSettings, Team
from cpcbl_transport.memory_bus import MemoryHub

HONEST = ("north", "south")
ONE, TWO, GUEST = ("west",), ("west", "east"), ("ghost",)
GUESTS = tuple(f"ghost{i}" for i in range(1, 6))
DRIFT = "drift:0.01,0.0,0.01"  # 1 cm/s, and it states 1 cm
CERTAIN = "drift:0.0,0.0,0.01"  # it adds nothing, and states 1 cm
ONE_AXIS = "one-axis:0.02,0.005,0.25"  # 2 cm/s in x, where it states 5 mm, and 25 cm in y
LEAST_INSIDE = 0.95  # of the victim's samples within 3 sigma, where nobody can find the liars
OWN_EYES_RATIO, BLIND_RATIO = 1.3, 1.5
RARE_HZ = 2.0
IN_OTHER_TEAMS = "drift", "overclaimed", "echo", "no majority"
USUAL_SENSOR = {"range_share": 0.05, "range_floor_m": 0.02, "bearing_sigma_deg": 3.0}
NAVIGATOR = {"victim": "navigator", "most_ratio": OWN_EYES_RATIO}


class Attack(Struct, frozen=True, kw_only=True):
    """One kind of liars and their victim. Without liars it is the run to compare with."""

    name: str = ""
    lie: str = ""  # a fault without its times
    liars: tuple[str, ...] = ()
    victim: str = "scout"
    most_ratio: float | None = BLIND_RATIO
    """The aim, to the RMSE without liars; None: nobody can find out, and sigma has to hold."""
    sends: str = "fixes"
    bystanders: tuple[str, ...] = ()  # driving robots to which the liars report, too
    honest: tuple[str, ...] = HONEST  # correct observers
    renamed_every_s: float | None = None  # liars come back under another name so often
    reports_hz: float = USUAL_HZ  # of all sensors, and of the liars
    has_good_observers: bool = True  # else all observers have the usual sensor of a robot
    from_s: float = 10.0
    end_s: float = 70.0

    @property
    def without(self) -> "Attack":
        """The same run without liars."""
        none = {"name": "", "lie": "", "liars": (), "sends": "fixes", "renamed_every_s": None}
        return replace(self, **none, most_ratio=BLIND_RATIO)


class AttackRun(NamedTuple):
    """What one run did to the victim."""

    score: Score  # from the beginning of the lie on
    noticed_after_s: float | None  # until it quarantined a liar, or said that one is contested
    false_quarantines: int  # of correct observers


class AttackRow(Struct, frozen=True, kw_only=True):
    """One attack over its seeds; worst means the seed in which it is worst."""

    attack: Attack
    rmse_m: float  # median
    ratio: float  # median, to the same seed without liars
    worst_ratio: float
    worst_nees: float
    least_inside_3_sigma: float
    noticed: int  # seeds
    noticed_after_s: float | None  # median
    false_quarantines: int  # over all seeds
    held: bool


def attacks() -> tuple[Attack, ...]:
    """A blind scout with an honest majority; a navigator with poor eyes against as many liars as
    there are correct observers; guests; and a scout without a majority."""
    drift = Attack(name="drift", lie=DRIFT)
    kinds = (
        drift,
        Attack(name="overclaimed", lie="overclaim:0.1,0.0,0.005"),
        Attack(name="one victim", lie=f"{DRIFT}/{{victim}}", bystanders=("scout2",)),
        Attack(name="sleeper", lie=DRIFT, from_s=120.0, end_s=180.0),
        Attack(name="beliefs", lie=DRIFT, sends="beliefs"),
        Attack(name="headings", lie="heading:1.0,1.0", sends="headings"),
        Attack(name="one axis", lie=ONE_AXIS, sends="gated"),
        Attack(name="echo", lie=DRIFT, sends="echoes"),
        Attack(name="amplified echo", lie=CERTAIN, sends="amplified"),
    )
    cases = [replace(kind, liars=ONE) for kind in kinds]
    cases += [replace(kind, liars=TWO, **NAVIGATOR) for kind in kinds]
    cases += [replace(drift, name="guest", liars=GUEST, **more) for more in ({}, NAVIGATOR)]
    cases += [replace(drift, name="no majority", liars=TWO, most_ratio=None)]
    sudden = Attack(lie="overclaim:0.5,0.0,0.01")
    renamed = Attack(lie="overclaim:0.25,0.0,0.005", renamed_every_s=4.0)
    cases += [
        replace(drift, name="five guests", liars=GUESTS),
        replace(sudden, name="five guests at once", liars=GUESTS),
        replace(renamed, name="guests with new names", liars=GUESTS),
        replace(renamed, name="new names, one robot", liars=GUESTS, honest=("north",)),
        replace(sudden, name="guests, one robot", liars=GUESTS, honest=("north",), most_ratio=None),
    ]
    chosen = [case for case in cases if case.name in IN_OTHER_TEAMS]
    cases += [replace(c, name=f"{c.name}, {RARE_HZ:g} Hz", reports_hz=RARE_HZ) for c in chosen]
    cases += [replace(c, name=f"{c.name}, 5 %", has_good_observers=False) for c in chosen]
    return tuple(replace(case, lie=case.lie.format(victim=case.victim)) for case in cases)


def with_bases(chosen: Sequence[Attack]) -> list[Attack]:
    """These attacks after the runs without liars that they are compared with."""
    return [*dict.fromkeys(attack.without for attack in chosen), *chosen]


def attack_team(attack: Attack) -> Team:
    """The team of an attack: two correct observers, the driving robots, and the liars, whose posts
    are west and east of the field. A guest is no robot of the team."""
    team = load_team(builtin_path("liars"))
    kept = {*attack.honest, attack.victim, *attack.bystanders, *attack.liars}
    west = team.robots["west"]
    assert west.start is not None
    start = replace(west.start, x_m=9.0, heading_deg=180.0)
    robots = {**team.robots, "east": replace(west, start=start)}
    return replace(team, robots={n: _equipped(r, attack) for n, r in robots.items() if n in kept})


def _equipped(robot: RobotSettings, attack: Attack) -> RobotSettings:
    """The robot with the sensor that it has in this attack."""
    is_usual = not (attack.has_good_observers or robot.odometry.moves)
    sensor = replace(robot.sensor, **(USUAL_SENSOR if is_usual else {}))
    return replace(robot, sensor=replace(sensor, rate_hz=attack.reports_hz))


def run_attack(attack: Attack, seed: int) -> AttackRun:
    """One run. The same attack and seed give the same figures."""
    team, hub = attack_team(attack), MemoryHub()
    recorder = Recorder(hub.session())
    reported = TrustWatch()
    reported.attach(hub.session())
    field = FieldNode(SimulatedField(team, seed, 0), hub.session())
    nodes = robot_nodes(team, hub, 0)
    correct = [n for name, n in zip(team.robots, nodes, strict=True) if name not in attack.liars]
    fault = Fault.parse(f"{attack.lie}@{attack.from_s}-") if attack.lie else None
    liars = (
        []
        if fault is None
        else [_lying_observer(attack, hub, fault, name, seed) for name in attack.liars]
    )
    run_nodes([field, *correct, *liars], 0, int(attack.end_s * 1e9))
    truth = recorder.simulated_truth()[attack.victim]
    of_victim = score(recorder.samples(attack.victim, truth, attack.from_s))
    doubted_s = reported.doubted_s(attack.victim)
    noticed_s = [at_s for name, at_s in doubted_s.items() if name.split(".")[0] in attack.liars]
    after_s = min(noticed_s) - attack.from_s if noticed_s else None
    quarantined = {q.of for q in reported.quarantines if q.by == attack.victim}
    return AttackRun(of_victim, after_s, len(quarantined & set(attack.honest)))


def _lying_observer(
    attack: Attack, hub: MemoryHub, fault: Fault, name: str, seed: int
) -> LyingObserver | RenamedLiar:
    told = attack.victim, *attack.bystanders

    def new(name: str) -> LyingObserver:
        how = attack.sends, attack.reports_hz
        return LyingObserver(hub.session(), name, told, fault, seed, *how)

    every_s = attack.renamed_every_s
    return new(name) if every_s is None else RenamedLiar(new, name, every_s)


# Over all seeds -----------------------------------------------------------------------------------


def attack_rows(results: Mapping[Attack, Sequence[AttackRun]]) -> tuple[AttackRow, ...]:
    """A row for each attack, and for each run without liars."""
    return tuple(_row(attack, runs, results[attack.without]) for attack, runs in results.items())


def _row(attack: Attack, runs: Sequence[AttackRun], without: Sequence[AttackRun]) -> AttackRow:
    ratios = [_rmse_m(a) / _rmse_m(b) for a, b in zip(runs, without, strict=True)]
    inside = min(run.score.inside_3_sigma or 0.0 for run in runs)
    noticed_s = [run.noticed_after_s for run in runs if run.noticed_after_s is not None]
    false = sum(run.false_quarantines for run in runs)
    if attack.most_ratio is None:  # it says so, and sigma holds
        held = inside >= LEAST_INSIDE and len(noticed_s) == len(runs)
    else:
        held = max(ratios) <= attack.most_ratio
    return AttackRow(
        attack=attack,
        rmse_m=median(_rmse_m(run) for run in runs),
        ratio=median(ratios),
        worst_ratio=max(ratios),
        worst_nees=max(run.score.nees or math.inf for run in runs),
        least_inside_3_sigma=inside,
        noticed=len(noticed_s),
        noticed_after_s=median(noticed_s) if noticed_s else None,
        false_quarantines=false,
        held=held and not (false and not attack.liars),
    )


def _rmse_m(run: AttackRun) -> float:
    return run.score.position_rmse_m or 0.0


def attack_tables(rows: Sequence[AttackRow], seeds: int) -> Iterable[RenderableType]:
    """A row for each attack, and which aims were missed."""
    figures = ("m", "worst", "NEES", "3 σ", "found", "s", "false")
    shown = table(f"attacks on one robot, {seeds} seeds", ("attack", "victim"), figures)
    for row in rows:
        shown.add_row(*_cells(row, seeds))
    yield shown
    yield (
        "A scout has one liar beside two correct observers, a navigator two (but one\n"
        "guest); without a majority a scout has two. Where guests lie there are five, twice\n"
        "beside one correct observer. In rows with 2 Hz all sensors and liars report so\n"
        "often; in rows with 5 % the observers have a usual sensor (5 % and 3°).\n"
        "Column m is the median RMSE; worst\n"
        "is the largest ratio of a seed to the same seed without liars. The aim is at most\n"
        f"{BLIND_RATIO:g} for a scout and {OWN_EYES_RATIO:g} for a navigator; "
        "without a majority σ has to hold.\n"
        "NEES and 3 σ are those of the worst seed. Column found counts the seeds in which\n"
        "the victim quarantined a liar or said that it is contested, s is the time until\n"
        "then, and false counts quarantines of correct observers."
    )
    missed = [
        f"{row.attack.name or 'no liar'} ({row.attack.victim})" for row in rows if not row.held
    ]
    yield f"The aim is missed for: {'; '.join(missed)}." if missed else "All aims are met."


def _cells(row: AttackRow, seeds: int) -> list[str]:
    attack, is_attack = row.attack, bool(row.attack.liars)
    return [
        _title(attack),
        attack.victim,
        number(row.rmse_m, 3),
        number(row.worst_ratio, 2) if is_attack else "",
        number(row.worst_nees, 1),
        f"{row.least_inside_3_sigma:.1%}",
        f"{row.noticed}/{seeds}" if is_attack else "",
        number(row.noticed_after_s, 1) if is_attack else "",
        str(row.false_quarantines),
    ]


def _title(attack: Attack) -> str:
    if attack.liars:
        return attack.name
    if attack.reports_hz != USUAL_HZ:
        return f"no liar, {attack.reports_hz:g} Hz"
    if not attack.has_good_observers:
        return "no liar, 5 %"
    return "no liar" if attack.end_s < 100.0 else "later"
