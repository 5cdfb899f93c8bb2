"""The contenders that `make compiled` builds, imported beside the interpreted ones."""

import importlib
import sys
from filecmp import cmpfiles
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType

from benchmarks import contenders

TOP = Path(__file__).parents[2]
FOLDER = TOP / "build" / "compiled"
_ANEW = ("cpcbl_team", "benchmarks", "support")
_NAMES = ("joint", "joint, alternating", "oval", "circular", contenders.YARDSTICK)


def fresh() -> bool:
    """Whether there is a compiled core, for this Python and of these very sources."""
    if not (FOLDER / "cpcbl_team" / f"localizer{EXTENSION_SUFFIXES[0]}").exists():
        return False
    core = [path.name for path in (TOP / "cpcbl_team").glob("*.py")]
    same, _, _ = cmpfiles(FOLDER / "cpcbl_team", TOP / "cpcbl_team", core, shallow=False)
    yardstick = ["float_ekf.py"]
    alike, _, _ = cmpfiles(FOLDER / "benchmarks", Path(__file__).parent, yardstick, shallow=False)
    return (same, alike) == (core, yardstick)


def imported_from(folder: Path, name: str) -> ModuleType:
    """A module and all that it imports of the core and the benchmarks, anew, from `folder` where
    they are there; those imported already stay what they are."""
    before = _taken_out()
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))
        _taken_out()
        sys.modules.update(before)


def _taken_out() -> dict[str, ModuleType]:
    names = [name for name in sys.modules if name.partition(".")[0] in _ANEW]
    return {name: sys.modules.pop(name) for name in names}


def _compiled() -> dict[str, contenders.Contender]:
    found = imported_from(FOLDER, "benchmarks.contenders").ALL
    return {f"{name}, compiled": found[name] for name in _NAMES}


COMPILED = _compiled() if fresh() else {}
ALL = {**contenders.ALL, **COMPILED}
