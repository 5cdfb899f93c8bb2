"""The stored reference of the net: reading, comparing, and renewing it (`make net`)."""

import lzma
import math
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec
from net.recording import Recording, Run

KINDS = ("states", "tracks")
RELATIVE_TOLERANCE = 1e-9  # on a platform whose mathematics rounds differently
_TOLERANCE = 1e-12  # of numbers near zero
_FOLDER = Path(__file__).parent / "reference"


class Difference(NamedTuple):
    """A value of a whole state that is not what it was."""

    run: str
    step: int
    field: str
    old: object
    new: object


def record(kind: str) -> Recording:
    """What the project computes now, in a process of its own with a fixed hash seed."""
    environment = {**os.environ, "PYTHONHASHSEED": "0", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "net.recording", kind]
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.decode())
    return msgspec.msgpack.decode(done.stdout, type=Recording)


def read_reference(kind: str) -> Recording:
    packed = lzma.decompress(_path(kind).read_bytes())
    return msgspec.msgpack.decode(packed, type=Recording)


def first_difference(old: Recording, new: Recording) -> str:
    """One readable line about the first difference; empty if there is none.

    On the reference's platform every bit counts, elsewhere a relative error of 1e-9.
    """
    if old.runs.keys() != new.runs.keys():
        return f"the runs were {sorted(old.runs)}, are {sorted(new.runs)}"
    exact = old.platform == new.platform
    for name, run in new.runs.items():
        if line := _first_in_run(name, old.runs[name], run, exact):
            return line
    return ""


def _first_in_run(name: str, old: Run, new: Run, exact: bool) -> str:
    if len(old.hashes) != len(new.hashes):
        return f"{name}: there were {len(old.hashes)} steps, there are {len(new.hashes)}"
    found = list(kept_differences(name, old, new, exact))
    step = next((i for i, h in enumerate(old.hashes) if exact and h != new.hashes[i]), None)
    if step is None and not found:
        return ""
    begin = found[0].step if step is None else step
    line = f"{name}: the states differ from step {begin} ({new.labels[begin]}) on"
    if not found:
        return f"{line}; no state that is stored whole differs"
    first = [d for d in found if d.step == found[0].step]
    fields = ", ".join(dict.fromkeys(_field_name(d.field).partition(".")[0] for d in first))
    return (
        f"{line}; in the first whole state, of step {first[0].step}, {first[0].field} was "
        f"{first[0].old!r}, is {first[0].new!r} ({len(first)} numbers differ, in: {fields})"
    )


def kept_differences(name: str, old: Run, new: Run, exact: bool) -> Iterator[Difference]:
    """What differs in the states that are stored whole, step by step."""
    for step in sorted(old.kept.keys() & new.kept.keys()):
        if msgspec.msgpack.encode(old.kept[step]) == msgspec.msgpack.encode(new.kept[step]):
            continue  # the same bits
        before, after = _flat(old.kept[step]), _flat(new.kept[step])
        for field in dict.fromkeys((*before, *after)):
            a, b = before.get(field, "absent"), after.get(field, "absent")
            if not _same(a, b, exact):
                yield Difference(name, step, field, a, b)


def _same(a: object, b: object, exact: bool) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        if exact or math.isnan(a):
            return a.hex() == b.hex()
        return math.isclose(a, b, rel_tol=RELATIVE_TOLERANCE, abs_tol=_TOLERANCE)
    return type(a) is type(b) and a == b


def _flat(value: object, path: str = "") -> dict[str, object]:
    """Each number and text by its path."""
    if isinstance(value, Mapping):
        inner = {f"{path}.{key}" if path else str(key): v for key, v in value.items()}
    elif isinstance(value, (list, tuple)):
        inner = {f"{path}[{i}]": v for i, v in enumerate(value)}
    else:
        return {path: value}
    found: dict[str, object] = {path: "empty"} if not inner else {}
    for key, v in inner.items():
        found |= _flat(v, key)
    return found


# Renewing -----------------------------------------------------------------------------------------


def renew(kind: str) -> Iterator[str]:
    """Stores what the project computes now; yields lines about what moved."""
    new = record(kind)
    if _path(kind).exists():
        yield from _moved(kind, read_reference(kind), new)
    stored = msgspec.structs.replace(
        new, runs={name: Run(run.hashes, [], run.kept) for name, run in new.runs.items()}
    )
    _FOLDER.mkdir(exist_ok=True)
    packed = lzma.compress(msgspec.msgpack.encode(stored), preset=9)
    _path(kind).write_bytes(packed)
    yield f"{kind}: {len(new.runs)} runs stored, {len(packed) / 1000:.0f} kB"


def _moved(kind: str, old: Recording, new: Recording) -> Iterator[str]:
    """A line about every run that moved, then one about every field."""
    if old.platform != new.platform:
        yield f"{kind}: the platform's mathematics rounds differently than the reference's"
    fields: dict[str, list[Difference]] = {}
    for name in sorted(old.runs.keys() | new.runs.keys()):
        before, after = old.runs.get(name, Run()), new.runs.get(name, Run())
        pairs = list(zip(before.hashes, after.hashes, strict=False))
        changed = sum(a != b for a, b in pairs)
        if changed or len(before.hashes) != len(after.hashes):
            steps = f"{len(before.hashes)} -> {len(after.hashes)}"
            yield f"{name}: {changed} of {len(pairs)} states moved; steps {steps}"
        for difference in kept_differences(name, before, after, exact=True):
            fields.setdefault(_field_name(difference.field), []).append(difference)
    for field, found in fields.items():
        states = len({(d.run, d.step) for d in found})
        yield f"  {field}: {states} whole states, largest difference {_largest(found)}"
    if not fields:
        yield f"{kind}: no state that is stored whole moved"


def _field_name(path: str) -> str:
    """The path without indices."""
    return "".join(part.partition("]")[2] if i else part for i, part in enumerate(path.split("[")))


def _largest(found: list[Difference]) -> str:
    pairs = [(d.old, d.new) for d in found]
    sizes = [
        abs(b - a) for a, b in pairs if isinstance(a, (int, float)) and isinstance(b, (int, float))
    ]
    if sizes:
        return f"{max(sizes):.3g}"
    old, new = pairs[0]
    return f"not a number: {old!r} -> {new!r}"


def _path(kind: str) -> Path:
    return _FOLDER / f"{kind}.msgpack.xz"


if __name__ == "__main__":
    for each in KINDS:
        for line in renew(each):
            sys.stdout.write(line + "\n")
