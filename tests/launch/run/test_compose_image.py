"""Who builds the image of a compose file is said with it, always."""

import subprocess

import pytest
from support.docker import TOP

from cpcbl_launch.run.containers.docker import version
from cpcbl_launch.run.processes import PROGRAM


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], f"`up` builds the image cpcbl-team:{version()} if it is missing; after a change of"),
        ([], "the sources: docker-compose -f FILE build"),
        (["--image", "mine:2"], "The image mine:2 must exist; in a checkout: docker build --file"),
    ],
)
def test_the_origin_of_the_image_is_said(options: list[str], said: str) -> None:
    command = [*PROGRAM, "compose", "demo", *options]
    printed = subprocess.run(command, cwd=TOP, capture_output=True, text=True, check=True)
    assert said in printed.stdout
    assert said in printed.stderr
