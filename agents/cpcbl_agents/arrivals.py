"""What has arrived for a robot and waits for its next step: messages, liveliness tokens, a frame.

Threads of the bus put it in, and the thread that steps the robot takes it out.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection

from cpcbl_agents.inbox import INBOX, Inbox
from cpcbl_transport import messages, topics

COUNTED = ("frame_skipped", "inbox_overflow", "news_overflow", "same_name_twice")


class Arrivals:
    """The arrivals of one robot's process. `on_arrival` is called on a thread of the bus."""

    def __init__(
        self, robot: str, incarnation: str, team: Collection[str], on_arrival: Callable[[], None]
    ) -> None:
        self._frame_key = topics.IN_FRAME.at(robot=robot)
        self._incarnation, self._on_arrival = incarnation, on_arrival
        self._inbox = Inbox(team)
        self._frames: deque[tuple[str, bytes]] = deque(maxlen=1)
        self._tokens: deque[tuple[str, bool]] = deque(maxlen=INBOX)
        self._namesakes: set[str] = set()  # tokens of other processes with this robot's name
        # Entries exist from the start: to add one while another thread reads them would fail
        self._counts: Counter[str] = Counter(dict.fromkeys(COUNTED, 0))

    # On a thread of the bus ---------------------------------------------------------------------

    def put_message(self, key: str, payload: bytes) -> None:
        if key == self._frame_key:  # only the latest: a robot that is slow sees less, not late
            if self._frames:
                self._counts["frame_skipped"] += 1
            self._frames.append((key, payload))
        else:
            # Enough to refuse it: it may be a large frame
            dropped = self._inbox.put(key, payload[: messages.LARGEST_PAYLOAD + 1])
            if dropped:
                self._counts["inbox_overflow"] += dropped
        self._on_arrival()

    def put_token(self, key: str, alive: bool) -> None:
        if len(self._tokens) == INBOX:
            self._counts["news_overflow"] += 1
        self._tokens.append((key, alive))
        self._on_arrival()

    def put_own_name(self, key: str, alive: bool) -> None:
        if key.endswith("/" + self._incarnation):
            return
        if alive:
            self._counts["same_name_twice"] += 1
            self._namesakes.add(key)
        else:
            self._namesakes.discard(key)

    # On the thread that steps the robot ---------------------------------------------------------

    @property
    def any_wait(self) -> bool:
        return bool(self._inbox or self._tokens or self._frames)

    @property
    def waiting_tokens(self) -> int:
        return len(self._tokens)

    @property
    def waiting_messages(self) -> int:
        return len(self._inbox)

    @property
    def counts(self) -> Counter[str]:
        """What the bus's threads counted, by event."""
        return self._counts

    @property
    def has_namesake(self) -> bool:
        """Whether another process has this robot's name."""
        return bool(self._namesakes)

    def take_token(self) -> tuple[str, bool]:
        """The oldest token; one must wait."""
        return self._tokens.popleft()

    def take_message(self) -> tuple[str, bytes]:
        """The next message; one must wait."""
        return self._inbox.take()

    def take_frame(self) -> tuple[str, bytes] | None:
        """The latest frame, if one waits."""
        return self._frames.popleft() if self._frames else None

    def note_taken(self, taken: int, waiting: int) -> None:
        """Notes that so many messages were taken of those that waited. If some are left, the next
        one is from the quietest sender, not the oldest."""
        self._inbox.is_fair = taken < waiting

    def pop_overflow(self) -> tuple[int, Counter[str]]:
        """How many messages wait, and how many were dropped since the last call, by sender."""
        return len(self._inbox), self._inbox.pop_dropped()
