"""Two sites of a team: the link between their routers is cut and healed."""

import time
from pathlib import Path

import pytest
from support.docker import composed
from support.processes import eventually

from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.run.containers.docker import command_output
from cpcbl_transport.zenoh_bus import open_bus

WEST, EAST = {"navigator", "observer"}, {"scout", "patrol"}
TOGETHER_WITHIN_S = 20.0  # mostly 1.3 to 2.5; TCP asks a lost SYN again after 1, 3, 7 and 15 s


def lengths(recorder: Recorder) -> dict[str, int]:
    return {name: len(tracks) for name, tracks in recorder.tracks.items()}


def grow(recorder: Recorder, names: set[str], within_s: float = 30.0) -> bool:
    """Whether more is heard of all of these robots."""
    before = lengths(recorder)

    def more() -> bool:
        now = lengths(recorder)
        return all(now.get(name, 0) > before.get(name, 0) + 5 for name in names)

    return eventually(more, within_s)


def silent(recorder: Recorder, names: set[str]) -> bool:
    """Whether nothing more is heard of these for two seconds, at some time."""

    def quiet() -> bool:
        before = lengths(recorder)
        time.sleep(2.0)
        now = lengths(recorder)
        return all(now[name] == before[name] for name in names)

    return eventually(quiet, 30.0)


def help_to(recorder: Recorder, name: str) -> int:
    """Fixes and beliefs that a robot says to have received."""
    status = recorder.latest()[1].get(name)
    return 0 if status is None else status.messages_received


@pytest.mark.docker
@pytest.mark.timeout(600)
def test_each_side_goes_on_through_a_cut_and_they_are_together_soon_after(tmp_path: Path) -> None:
    with (
        composed("two-sites.yaml", tmp_path, ("7447", "7448")) as (project, (west, east)),
        open_bus("demo", [west]) as western,
        open_bus("demo", [east]) as eastern,
    ):
        in_the_west, in_the_east = Recorder(western), Recorder(eastern)
        for recorder in (in_the_west, in_the_east):
            assert eventually(lambda r=recorder: r.tracks.keys() == WEST | EAST, 60.0)  # type: ignore[misc]
        assert eventually(lambda: help_to(in_the_east, "scout") > 20, 60.0), "no help"
        started = project.started()
        link = (f"{project.name}_link", project.id_of("router-east"))

        command_output(["docker", "network", "disconnect", *link])
        assert silent(in_the_west, EAST)
        assert silent(in_the_east, WEST)
        assert grow(in_the_west, WEST)
        assert grow(in_the_east, EAST)

        command_output(["docker", "network", "connect", *link])
        healed_s, before = time.monotonic(), help_to(in_the_east, "scout")
        assert grow(in_the_west, EAST, TOGETHER_WITHIN_S)
        assert grow(in_the_east, WEST, TOGETHER_WITHIN_S)
        print(f"together again {time.monotonic() - healed_s:.1f} s after the link was healed")  # noqa: T201
        assert eventually(lambda: help_to(in_the_east, "scout") > before + 5), "no help any more"
        assert project.started() == started
