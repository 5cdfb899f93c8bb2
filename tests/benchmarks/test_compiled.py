"""The compiled core is compiled, and says what the interpreted one says. No times here."""

from typing import Any

import pytest
from benchmarks.compiled import COMPILED, FOLDER, fresh, imported_from
from benchmarks.contenders import ALL as INTERPRETED
from benchmarks.contenders import OURS
from benchmarks.drive import drive

pytestmark = pytest.mark.skipif(not fresh(), reason="nothing compiled of these sources")
DRIVE = drive()


def final(contender: Any) -> Any:
    return contender.run(map(contender.reading, DRIVE))


@pytest.mark.parametrize("name", ["cpcbl_team.localizer", "benchmarks.float_ekf"])
def test_it_is_compiled(name: str) -> None:
    where = imported_from(FOLDER, name).__file__
    assert where is not None
    assert where.startswith(str(FOLDER))
    assert not where.endswith(".py")


@pytest.mark.parametrize("name", COMPILED)
def test_it_ends_where_the_interpreted_one_does(name: str) -> None:
    compiled, interpreted = COMPILED[name], INTERPRETED[name.removesuffix(", compiled")]
    assert compiled.pose(final(compiled)) == pytest.approx(
        interpreted.pose(final(interpreted)), rel=1e-12, abs=1e-12
    )


@pytest.mark.parametrize("name", [n for n in OURS if f"{n}, compiled" in COMPILED])
def test_its_state_is_that_of_the_interpreted_one(name: str) -> None:
    compiled, interpreted = final(COMPILED[f"{name}, compiled"]), final(OURS[name])
    covariance = interpreted.estimate.covariance
    assert compiled.estimate.covariance == pytest.approx(covariance, rel=1e-12, abs=1e-15)
    assert compiled.updates == interpreted.updates
    assert len(compiled.memory.recovery.evidence) == len(interpreted.memory.recovery.evidence)
