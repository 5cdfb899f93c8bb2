"""`cpcbl-team view`: serves the page, and meanwhile looks for the team's router."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from cpcbl_launch.recordings.merge import indexed_recording
from cpcbl_launch.views.web.address import Listen
from cpcbl_launch.views.web.feed import Feed
from cpcbl_launch.views.web.playback import Playback
from cpcbl_launch.views.web.server import ShownTeam, serve
from cpcbl_transport.security import Link
from cpcbl_transport.zenoh_bus import BusError, ZenohBus, open_bus

TRY_S = 1.0  # after so long the page says why there is no router yet
REFRESH_S = 0.25


def view_team(
    shown: ShownTeam,
    link: Link,
    listen: Listen,
    stop: Callable[[], bool],
    show_address: Callable[[str], None],
) -> None:
    """Serves until `stop()`. Raises InputError where it cannot listen."""
    feed = Feed(shown.team.robots if shown.team else ())
    with serve(shown, feed, listen) as address:
        show_address(address)
        bus = _open_bus(shown.name, link, stop, feed.set_problem)
        if bus is None:
            return
        with bus, feed.attach(bus):
            while not stop():
                lost = f"The connection to the router at {shown.where} is lost"
                feed.set_problem("" if bus.neighbours() else lost)
                time.sleep(REFRESH_S)


def address_lines(team: str, address: str, listen: Listen) -> Iterator[str]:
    """What a person reads who has started the view."""
    yield f"view of team {team}: {address}"
    if listen.port and not address.endswith(f":{listen.port}/"):
        yield f"(port {listen.port} is taken; {listen.option} ADDRESS:PORT chooses another)"
    if listen.is_open:
        yield "Everybody who reaches this address can watch the team, and its cameras."


def _open_bus(
    team: str, link: Link, stop: Callable[[], bool], say: Callable[[str], None]
) -> ZenohBus | None:
    """A session, as soon as a router answers; None where `stop()` came first."""
    while not stop():
        until_s = time.monotonic() + TRY_S

        def is_over(until_s: float = until_s) -> bool:
            return stop() or time.monotonic() > until_s

        try:
            return open_bus(team, link.endpoints, is_over, link.credentials)
        except BusError as error:
            reason = str(error)
            say(reason[:1].upper() + reason[1:])
    return None


def view_recording(
    run: Path, listen: Listen, stop: Callable[[], bool], show_address: Callable[[str, str], None]
) -> None:
    """Serves a recorded run until `stop()`. Raises LogError, InputError."""
    with indexed_recording(run) as recording:
        playback = Playback(recording)
        shown = ShownTeam(recording.team.name, str(run), recording.team, playback)
        with playback.running(), serve(shown, playback.feed, listen) as address:
            show_address(shown.name, address)
            while not stop():
                time.sleep(REFRESH_S)
