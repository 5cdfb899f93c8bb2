"""Who builds the image of a compose file is said with it, always."""

import pytest
from support.docker import TOP
from support.processes import command_line

from cpcbl_launch.run.containers.docker import version


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], f"`up` builds the image cpcbl-team:{version()} if it is missing; after a change of"),
        ([], "the sources: docker-compose -f FILE build"),
        (["--image", "mine:2"], "The image mine:2 must exist; in a checkout: docker build --file"),
    ],
)
def test_the_origin_of_the_image_is_said(
    options: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(TOP)
    printed = command_line("compose", "demo", *options)
    assert printed.returncode == 0
    assert said in printed.stdout
    assert said in printed.stderr
