"""Files with the state of a replayed node, which `replay --dump` writes and `--from` reads."""

import zlib
from pathlib import Path

import msgspec

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.team.faults import one_line
from cpcbl_team.errors import InputError

MAGIC = b"cpcbl-state 1\n"
LARGEST = 64 * 1024 * 1024  # unpacked bytes


class NodeState(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a node after a step of its process."""

    version: str  # of this program, and a digest of its sources
    robot: str
    incarnation: str
    step: int  # the number of the latest one
    now_ns: int  # of that step
    state: bytes
    where: str = ""  # the file that it was read from

    def require_process(self, robot: str, incarnation: str) -> None:
        """Raises LogError for another process."""
        if (self.robot, self.incarnation) != (robot, incarnation):
            own = f"{self.robot}/{self.incarnation}"
            raise LogError(
                f"{self.where}: the state of {one_line(own, 80)}, not of {robot}/{incarnation}"
            )


def write_state(path: Path, state: NodeState) -> None:
    """Raises InputError."""
    packed = zlib.compress(msgspec.msgpack.encode(state))
    try:
        path.write_bytes(MAGIC + zlib.crc32(packed).to_bytes(4, "little") + packed)
    except OSError as error:
        raise InputError(f"--dump {path}: {error.strerror}; name another file") from error


def read_state(path: Path) -> NodeState:
    """Raises LogError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"--from {path}: cannot be read: {error.strerror or error}") from error
    head, packed = data[: len(MAGIC)], data[len(MAGIC) + 4 :]
    checksum = int.from_bytes(data[len(MAGIC) : len(MAGIC) + 4], "little")
    if head != MAGIC or zlib.crc32(packed) != checksum:
        raise LogError(f"--from {path}: no state that `replay --dump` wrote, or a damaged one")
    try:
        unpacker = zlib.decompressobj()
        state = msgspec.msgpack.decode(unpacker.decompress(packed, LARGEST), type=NodeState)
    except (zlib.error, msgspec.MsgspecError) as error:
        raise LogError(
            f"--from {path}: no state that `replay --dump` wrote: {one_line(str(error))}"
        ) from error
    return msgspec.structs.replace(state, where=f"--from {path}")
