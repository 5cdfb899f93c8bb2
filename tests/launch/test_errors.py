"""Errors of a user are one line and an exit code; a bug is a traceback."""

import re
from collections.abc import Callable, Iterator

import pytest

import cpcbl_launch.lab.chaos.scenario
import cpcbl_launch.lab.chaos.team
import cpcbl_launch.mapping.normal_equations
import cpcbl_launch.run.containers.docker
import cpcbl_launch.team.file  # noqa: F401  these modules define the errors of the tree
from cpcbl_agents.clock import Clock
from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch import cli
from cpcbl_team.errors import ClockError, CpcblError, DependencyError, InputError
from cpcbl_transport.security import SecurityError
from cpcbl_transport.zenoh_bus import BusError


def raising(error: BaseException) -> Callable[[], None]:
    """A command that fails with this error."""

    def command() -> None:
        raise error

    return command


@pytest.mark.parametrize(
    "kind", [InputError, LogError, DependencyError, ClockError, BusError, SecurityError]
)
def test_an_error_of_the_user_is_one_line_and_exit_code_2(
    kind: type[CpcblError], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "_run_command", raising(kind("team.toml: no such file")))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err == "cpcbl-team: team.toml: no such file\n"


@pytest.mark.parametrize("bug", [ValueError("a bug"), TypeError("a bug"), KeyError("a bug")])
def test_a_bug_is_not_taken_for_an_error_of_the_user(
    bug: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "_run_command", raising(bug))
    with pytest.raises(type(bug), match="a bug"):
        cli.main()


def test_the_docstring_of_the_root_draws_the_whole_tree() -> None:
    drawn = re.findall(r"[├└]── (\w+)", CpcblError.__doc__ or "")
    assert sorted(drawn) == sorted(kind.__name__ for kind in below(CpcblError))


def below(root: type[Exception]) -> Iterator[type[Exception]]:
    """All classes that derive from another."""
    for kind in root.__subclasses__():
        yield kind
        yield from below(kind)


@pytest.mark.parametrize("text", ["now", "1:2", "1:2:fast"])
def test_a_clock_that_cannot_be_read_is_an_error_of_the_user(text: str) -> None:
    with pytest.raises(InputError, match=f"--clock {text}: write"):
        Clock.parse(text)
