"""What happened to the robots of a run, in words: processes that began, states that changed."""

from collections.abc import Iterator
from typing import NamedTuple

from cpcbl_agents.input_diagnosis.problems import without_numbers
from cpcbl_agents.robot_state import Severity, robot_state
from cpcbl_team.frames import FIELD, frame_text
from cpcbl_transport.messages import Message, Status, Track


class Event(NamedTuple):
    """Something that happened to a robot, at a time by the stamps of its messages."""

    at_ns: int
    robot: str
    words: str
    severity: Severity


class _Latest:
    """The latest of one robot."""

    def __init__(self) -> None:
        self.track: Track | None = None
        self.status: Status | None = None
        self.words = ""


class EventLog:
    """Finds events in the messages of a run, which come in the order of their times."""

    def __init__(self) -> None:
        self._robots: dict[str, _Latest] = {}

    def events(self, at_ns: int, message: Message) -> Iterator[Event]:
        """What a message says that is new."""
        if not isinstance(message, Track | Status):
            return
        robot = self._robots.setdefault(message.robot, _Latest())
        if isinstance(message, Track):
            before = robot.track
            robot.track = message
            if message.frame != (FIELD if before is None else before.frame):
                frame = frame_text(message.frame)
                yield Event(at_ns, message.robot, f"is in frame {frame}", "good")
            if before is not None and before.lost == message.lost:
                return
        else:
            yield from _starts(at_ns, robot.status, message)
            robot.status = message
        found = robot_state(robot.status, robot.track)
        words = f"{found.word}: {found.why}" if found.why else found.word
        if without_numbers(words) != without_numbers(robot.words):
            robot.words = words
            yield Event(at_ns, message.robot, words, found.severity)


def _starts(at_ns: int, before: Status | None, status: Status) -> Iterator[Event]:
    """The first status of a process."""
    if before is None:
        yield Event(at_ns, status.robot, f"process {status.incarnation} runs", "good")
    elif before.incarnation != status.incarnation:
        words = f"another process runs: {status.incarnation}"
        yield Event(at_ns, status.robot, words, "warning")
