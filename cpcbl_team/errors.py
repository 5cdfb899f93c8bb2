"""The errors that a user can cause, and can mend: one root for all of them."""

from collections.abc import Iterable


class CpcblError(Exception):
    """Something that a user can cause; its text is one line that names the cause and the remedy.

    The command line catches this class and `OSError`, and nothing else: every other exception is a
    bug, and ends the program with a traceback.

        CpcblError
        ├── InputError          an option, an argument or a file of the user
        │   ├── TeamFileError   a team file (cpcbl_launch.team.file)
        │   ├── LogError        a log or a recording (cpcbl_agents.sources.mrclam)
        │   ├── RosNameError    a name that ROS 2 does not allow (cpcbl_transport.ros2)
        │   └── UndeterminedError   drives that give no map (cpcbl_launch.mapping)
        ├── DependencyError     a package or a system that this machine does not have
        ├── ClockError          the machine's clock was set while a robot ran
        ├── BusError            no router, or a router that cannot listen (cpcbl_transport)
        ├── SecurityError       keys or endpoints of a secured team (cpcbl_transport.security)
        ├── DockerError         Docker refused, or did not end in time (cpcbl_launch.run.containers)
        ├── MissingError        a fault scenario that cannot run here (cpcbl_launch.lab.chaos)
        └── ChaosError          a fault scenario that failed to run (cpcbl_launch.lab.chaos)

    Errors of an external library are converted where the file is read. A `ValueError`
    of this project reports a mistake of the programmer, such as a negative variance.
    """


class InputError(CpcblError):
    """An option, an argument or a file of the user cannot be used."""


class DependencyError(CpcblError):
    """This machine lacks a package or a facility; the text says how to get it."""


class ClockError(CpcblError):
    """The clock of this machine was set while a robot with real inputs was running."""


def nearest_name(name: str, known: Iterable[str], least_ratio: float = 0.6) -> str:
    """The known name that is spelled most like this one, whatever their case; empty if none is as
    similar as `least_ratio` (of difflib's SequenceMatcher)."""
    from difflib import get_close_matches  # only what goes wrong needs it

    by_folded = {other.casefold(): other for other in sorted(known)}
    near = get_close_matches(name.casefold(), by_folded, n=1, cutoff=least_ratio)
    return by_folded[near[0]] if near else ""
