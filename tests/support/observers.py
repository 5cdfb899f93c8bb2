"""The team that observers join in the tests."""

from typing import Any

import msgspec

from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Team

BLIND = load_team(builtin_path("blind"))


def changed(**fields: Any) -> Team:
    return msgspec.structs.replace(BLIND, **fields)
