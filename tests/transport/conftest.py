"""A secured team with its router."""

from collections.abc import Iterator

import pytest
from support.keys import (
    ROUTER,
    secured_team,
    shown_by,
)
from support.routers import open_router
from support.secured_team import MARK

from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.security import (
    access_control,
)


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Team:
    return secured_team(tmp_path_factory.mktemp("keys"))


@pytest.fixture(scope="module")
def endpoint(team: Team) -> Iterator[str]:
    """Where the team's router listens. All its members may also say `mark`, for the tests."""
    where = free_endpoint("tls")
    rules = access_control(team)
    access = rules["access_control"]
    mark = {**access["rules"][0], "id": MARK, "flows": ["ingress"], "messages": ["put"]}
    mark["key_exprs"] = [f"{topics.namespace(team.name)}/{MARK}"]
    access["rules"].append(mark)
    access["policies"].append({"rules": [MARK], "subjects": [access["subjects"][0]["id"]]})
    with open_router(team.name, [where], guards=rules, credentials=shown_by(team, ROUTER)):
        yield where
