"""A damaged team file is a team, or one line for each fault; never anything else."""

import random
import re
from pathlib import Path

import pytest

from cpcbl_launch.team.checks import warnings
from cpcbl_launch.team.faults import LARGEST
from cpcbl_launch.team.file import MOST_LINES, TeamFileError, builtin_path, load_team

SEEDS = [builtin_path(name) for name in ("demo", "eyes", "blind", "mrclam", "worlds")]
VALUES = (
    *("1e308", "-1e308", "1e-320", "nan", "inf", "-1", "0", "1e400", "9" * 400, "9" * 5000),
    *("true", '""', '"x"', '"\\u0000"', "[]", "[[]]", "{}", "2020-01-01", f"{LARGEST:g}", "[1, 2]"),
    *("[" * 900 + "]" * 900, "{a = " * 300 + "1" + "}" * 300, '"' + "y" * 4000 + '"'),
)
KEYS = ("x", "a.b.c", ".".join("k" * 600), '"a b"', '""', "range_sigma_m", '"\\n"', "k" * 3000)


def mutated(text: str, rng: random.Random) -> bytes:
    """A text with one to four changes that hands, editors and disks make."""
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(text) + 1)
        lines = text.splitlines()
        line = rng.randrange(len(lines)) if lines else 0
        match rng.randrange(7):
            case 0:
                text = _replaced(r"(?<== )[-\w.\"]+", text, rng.choice(VALUES), rng)
            case 1:
                text = _replaced(r"[\w.]+(?= = )", text, rng.choice(KEYS), rng)
            case 2:
                text = "\n".join([*lines[:line], *lines[line + 1 :]])
            case 3:
                text = "\n".join([*lines[:line], *lines[line : line + 1] * 2, *lines[line + 1 :]])
            case 4:
                text = text[:place] + rng.choice('[]{}="\\\n\x00\ud7ff,.#é') + text[place:]
            case 5:
                text = text[:place] + text[place + rng.randint(1, 30) :]
            case _:
                text = text[:place] if rng.random() < 0.2 else text + f"\n{rng.choice(KEYS)} = 1\n"
    data = text.encode()
    return data if rng.random() < 0.95 else data[:40] + b"\xff\xfe" + data[40:]


def _replaced(pattern: str, text: str, new: str, rng: random.Random) -> str:
    """A text with one of the matches of a pattern replaced."""
    places = [match.span() for match in re.finditer(pattern, text)] or [(0, 0)]
    start, end = rng.choice(places)
    return text[:start] + new + text[end:]


def assert_usable_or_explained(path: Path) -> bool:
    """Whether a file is a team; if not, what is said of it is short lines that name it."""
    try:
        team = load_team(path)
    except TeamFileError as error:
        lines = str(error).split("\n")
        assert 1 <= len(lines) <= MOST_LINES
        for line in lines:
            assert line.startswith(f"{path}: ")
            assert line.isprintable()
            assert len(line) < len(str(path)) + 320
        return False
    assert all(line.isprintable() for line in warnings(team))
    return True


@pytest.mark.parametrize("count", [200, pytest.param(5_000, marks=pytest.mark.long)])
def test_every_damaged_file_is_a_team_or_is_explained(count: int, tmp_path: Path) -> None:
    rng, path = random.Random(16), tmp_path / "team.toml"
    texts = [seed.read_text() for seed in SEEDS]
    usable = 0
    for _ in range(count):
        path.write_bytes(mutated(rng.choice(texts), rng))
        usable += assert_usable_or_explained(path)
    assert 0 < usable < count
