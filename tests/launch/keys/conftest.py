"""The team file of the tests of keys."""

from pathlib import Path

import pytest
from support.key_commands import TEAM


@pytest.fixture
def team_file(tmp_path: Path) -> Path:
    path = tmp_path / "team.toml"
    path.write_text(TEAM)
    return path
