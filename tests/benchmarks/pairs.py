"""`make bench-pairs`: what-if beside the truth over many pairs, as a table for the docs.

Each pair is a simulated run that is recorded, and the same run really made with a change. Robots
drive as commanded beforehand (open loop), with messages that arrive at once or some time later, or
by their own estimates (closed loop), where what-if cannot know how they would have driven.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import msgspec
from support.paired import SECONDS, SIZE, changed_world, pair, simulate_world

from cpcbl_launch.lab.seeds import Workers, run_seeds
from cpcbl_launch.lab.what_if.comparison import what_if
from cpcbl_launch.lab.what_if.inputs import read_inputs
from cpcbl_launch.reporting.recorder import Report, mean_score

KINDS = {"open": (True, 0.0), "late": (True, 0.1), "closed": (False, 0.0)}
"""Whether robots drive as commanded beforehand, and how late a message is at most (s)."""
EQUAL_M = 1e-9  # a mean is rounded otherwise
SHARE = 0.1  # of the true change, within which it is to be foretold
LEAST = 0.05  # of the RMSE: smaller changes are judged by their difference in metres alone


class Pair(msgspec.Struct, frozen=True, kw_only=True):
    """One pair: the team's RMSE as it is and as it is foretold, over the robots of both runs."""

    kind: str
    number: int
    change: str
    before_m: float
    after_m: float
    again_m: float
    foretold_m: float

    @property
    def change_m(self) -> float:
        return self.after_m - self.before_m

    @property
    def miss_m(self) -> float:
        """The foretold change minus the true one."""
        return self.foretold_m - self.again_m - self.change_m

    @property
    def is_large(self) -> bool:
        return abs(self.change_m) > LEAST * self.before_m

    @property
    def is_within(self) -> bool:
        return abs(self.miss_m) <= SHARE * max(abs(self.change_m), LEAST * self.before_m)


def measure(kind: str, number: int, size: int, duration_s: float) -> Pair:
    """One pair of this kind, of so many robots for so many seconds."""
    world, change = pair(number, *KINDS[kind], size, duration_s)
    with TemporaryDirectory() as folder:
        before = simulate_world(world, folder=Path(folder) / "run")
        result = what_if(read_inputs(Path(folder) / "run"), change, where=Workers(1))
    after = simulate_world(*changed_world(world, change))
    assert result.changed is not None
    return Pair(
        kind=kind,
        number=number,
        change=str(change),
        before_m=_rmse_m(before, after),
        after_m=_rmse_m(after, after),
        again_m=result.again.team.rmse_m or 0.0,
        foretold_m=result.changed.team.rmse_m or 0.0,
    )


def _rmse_m(report: Report, common: Report) -> float:
    """The team's RMSE over the robots of both runs."""
    return mean_score(report.robots[name] for name in common.robots).position_rmse_m or 0.0


def rows(pairs: Sequence[Pair]) -> list[str]:
    """A line for each kind, in Markdown."""
    found = ["| robots drive | pairs | equal | within 10 % | median miss | largest miss |"]
    found.append("|---|---|---|---|---|---|")
    for kind in dict.fromkeys(p.kind for p in pairs):
        of_kind = [p for p in pairs if p.kind == kind]
        exact = sum(abs(p.miss_m) < EQUAL_M for p in of_kind)
        misses = sorted(abs(p.miss_m) for p in of_kind)
        within = sum(p.is_within for p in of_kind)
        figures = f"{median(misses):.4f} m | {misses[-1]:.4f} m"
        found.append(f"| {kind} | {len(of_kind)} | {exact} | {within} | {figures} |")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--team-size", type=int, default=SIZE)
    parser.add_argument("--duration", type=float, default=SECONDS)
    parser.add_argument("--jobs", type=int)
    parser.add_argument("--output", type=Path, default=Path("build/what_if.json"))
    chosen = parser.parse_args()
    how = chosen.team_size, chosen.duration
    numbers = range(1, chosen.pairs + 1)
    tasks = [(kind, number, *how) for kind in chosen.kinds.split(",") for number in numbers]
    pairs = run_seeds(measure, tasks, Workers(chosen.jobs))
    chosen.output.write_bytes(msgspec.json.format(msgspec.json.encode(pairs), indent=1))
    sys.stdout.write("\n".join(rows(pairs)) + "\n")


if __name__ == "__main__":
    main()
