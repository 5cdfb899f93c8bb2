"""A run in one file (MCAP, mcap.dev): inputs and outputs of robots, the truth, the team.

Messages are JSON arrays, as on the wire but readable; the team is the attachment `team.json`. The
inputs of a robot that replays a log are not on the bus, so not in the file either. Of cameras there
is what robots show while somebody looks, twice a second: what was found under `look/<robot>`, the
annotated frame under `picture/<robot>`, as Foxglove shows pictures (`compressed_image.json`, of
docs.foxglove.dev/docs/visualization/message-schemas/compressed-image).
"""

import logging
import struct
import threading
from contextlib import AbstractContextManager, suppress
from importlib.resources import files
from pathlib import Path

import msgspec
from mcap.exceptions import McapError
from mcap.writer import Writer
from zstandard import ZstdError

from cpcbl_agents.flight_recorder import without_passwords
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import AnnotatedFrame, Message, Refusal

log = logging.getLogger(__name__)

RECORDED = (
    *(topics.IN_ODOMETRY, topics.IN_SIGHTINGS, topics.IN_POSITION),
    topics.IN_INITIAL_POSE,  # not frames: they are large
    *(topics.TRACK, topics.STATUS, topics.TRUTH, topics.LOOK),
)
TEAM = "team.json"
CHUNK_BYTES = 262_144  # of messages that wait in memory, with as much for their index
PICTURE, PICTURES = "foxglove.CompressedImage", "picture/"  # schema, beginning of keys
DAMAGE = (  # what the readers of MCAP, its compressions and its contents raise of a damaged file
    *(McapError, struct.error, ZstdError, RuntimeError, msgspec.MsgspecError),
    *(ValueError, LookupError, OverflowError, EOFError, MemoryError),
)


class Recording(AbstractContextManager["Recording"]):
    """Writes the messages on a bus into a file, until it is closed. Raises OSError at the start;
    later `failed` says why no more could be written."""

    def __init__(self, path: Path, team: Team, bus: Bus) -> None:
        self._lock = threading.Lock()
        self._path, self.failed = path, ""
        self._file = path.open("wb")
        self._writer: Writer | None = Writer(self._file, CHUNK_BYTES)
        self._writer.start(profile="cpcbl", library="cpcbl-team")
        attached = msgspec.json.encode(without_passwords(team))
        self._writer.add_attachment(0, 0, TEAM, "application/json", attached)
        self._channels: dict[str, int] = {}
        self._schema = 0
        self._handles = [bus.subscribe(topic.at(), self._receive) for topic in RECORDED]

    def _receive(self, key: str, payload: bytes) -> None:
        message = decode(key, payload)
        if isinstance(message, Refusal) or message.stamp_ns < 0:  # a file knows no time before 1970
            return
        with self._lock:
            if self._writer is None:
                return
            try:
                self._write(self._writer, key, message)
            except OSError as error:  # a full disk must not end the run
                self._give_up(error)

    def _write(self, writer: Writer, key: str, message: Message) -> None:
        if isinstance(message, AnnotatedFrame):
            if message.image:
                if not self._schema:
                    schema = (files(__package__) / "compressed_image.json").read_bytes()
                    self._schema = writer.register_schema(PICTURE, "jsonschema", schema)
                sec, nsec = divmod(message.stamp_ns, 10**9)
                picture = {
                    "timestamp": {"sec": sec, "nsec": nsec},
                    "frame_id": message.robot,
                    "data": message.image,
                    "format": "jpeg",
                }
                self._add(writer, f"{PICTURES}{message.robot}", message.stamp_ns, picture)
            message = msgspec.structs.replace(message, image=b"")
        self._add(writer, key, message.stamp_ns, message)

    def _add(self, writer: Writer, key: str, at_ns: int, content: object) -> None:
        if key not in self._channels:
            schema = self._schema if key.startswith(PICTURES) else 0
            self._channels[key] = writer.register_channel(key, "json", schema)
        writer.add_message(self._channels[key], at_ns, msgspec.json.encode(content), at_ns)

    def _give_up(self, error: OSError) -> None:
        self.failed = error.strerror or str(error)
        log.error("%s: no longer recorded: %s; the run goes on", self._path, self.failed)
        self._writer = None
        with suppress(OSError):  # what is left in the buffer finds no room either
            self._file.close()

    def __exit__(self, *_: object) -> None:
        for handle in self._handles:
            handle.close()
        with self._lock:
            if self._writer is None:
                return
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._writer = None
                self._file.close()
            except OSError as error:
                self._give_up(error)
