"""Changes that hands, disks and enemies make to files: of bytes, and of what the bytes mean."""

import json
import random
import struct
import zlib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

NUMBERS = (
    *(0, -1, 1, 2**31, 2**63 - 1, 2**64, -(2**63), 10**30),
    *(0.0, -0.0, 1e308, -1e308, 5e-324, 1e-9, 1e6, 1e7, 1.5, float("nan"), float("inf")),
)
ALLOWED = (0.0, 1e6, -1e6, 1e-9, 1e3, -0.5, 1.0, 1e-3, 5.0, 360.0)  # in many keys
TEXTS = ("", "x", "r1", "é\n\t\x1b[31m", "a/b", "*", "y" * 5000, "../../etc/passwd", "\u202e", "0")
VALUES: tuple[Any, ...] = (*NUMBERS, *TEXTS, True, [], [[]], [1, 2], {}, {"a": {"b": {}}}, [{}])
WORDS = (*map(str, NUMBERS), "", "x", "1e400", "9" * 5000, "0x10", "1,5", "#", "-", '"1"')


def mutated_bytes(data: bytes, rng: random.Random) -> bytes:
    """With one to four changes: bits, bytes, blocks; removed, repeated, exchanged, cut off."""
    for _ in range(rng.randint(1, 4)):
        at, size = rng.randrange(len(data) + 1), rng.choice((1, 1, 4, 30, 400))
        block = data[at : at + size]
        match rng.randrange(7):
            case 0 if at < len(data):
                data = data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
            case 1:
                data = data[:at] + rng.randbytes(len(block)) + data[at + size :]
            case 2:
                data = data[:at] + data[at + size :]
            case 3:
                data = data[:at] + block * rng.choice((2, 3, 50)) + data[at + size :]
            case 4:
                data = data[:at] + rng.choice((b"\x00", b"\xff")) * len(block) + data[at + size :]
            case 5:
                other = rng.randrange(len(data) + 1)
                data = data[:at] + data[other : other + size] + data[at + size :]
            case _:
                data = data[:at] if rng.random() < 0.3 else data + rng.randbytes(size)
    return data


def write_mutated_json(path: Path, data: bytes, rng: random.Random, share: float) -> None:
    """Writes a JSON file with changes: in this share of cases of its bytes, else of its values."""
    if rng.random() < share:
        path.write_bytes(mutated_bytes(data, rng))
        return
    tree = json.loads(data)
    mutated_tree(tree, rng)
    path.write_text(json.dumps(tree))


def mutated_tree(tree: Any, rng: random.Random, values: tuple[Any, ...] = VALUES) -> None:
    """Changes one to three places of tables and lists in each other: values to extremes; keys
    renamed, copied, moved into a deeper table, removed."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        parent, key = rng.choice(_places(tree))
        if type(parent[key]) in (int, float) and rng.random() < 0.7:
            parent[key] = type(parent[key])(rng.choice(ALLOWED))
            continue
        match rng.randrange(8):
            case 0 | 1 | 2 | 3:
                parent[key] = deepcopy(rng.choice(values))  # a later change is of this file only
            case 4 if isinstance(parent, dict):
                parent[rng.choice(("x", "start", f"{key}_m", str(key)[:-1]))] = parent.pop(key)
            case 5:
                other, name = rng.choice(_places(tree))
                parent[key] = other[name] if not isinstance(other[name], dict | list) else {}
            case 6:
                for _ in range(rng.choice((1, 3, 60))):
                    parent[key] = {rng.choice(("a", str(key))): parent[key]}
            case _:
                del parent[key]
                if not _places(tree):
                    return


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Every place of a value: the table or list that holds it, and its key there."""
    found, parts = [], [tree]
    for part in parts:  # the list grows meanwhile
        keys = list(part) if isinstance(part, dict) else range(len(part))
        found += [(part, key) for key in keys]
        parts += [part[key] for key in keys if isinstance(part[key], dict | list)]
    return found


def mutated_rows(text: str, rng: random.Random) -> str:
    """Changes rows and columns of a table of numbers."""
    rows = [line.split("\t") for line in text.splitlines()]
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(rows))
        row, column = rows[at], rng.randrange(len(rows[at]))
        match rng.randrange(9):
            case 0 | 1 | 2:
                row[column] = rng.choice(WORDS)
            case 3:
                row.insert(column, rng.choice(WORDS))
            case 4:
                del row[column]
                row = row or [""]
            case 5:
                rows[at:at] = [list(row) for _ in range(rng.choice((1, 40)))]
            case 6:
                other = rng.randrange(len(rows))
                rows[at], rows[other] = rows[other], rows[at]
            case 7:  # another epoch
                rows[at:] = [[rng.choice(WORDS), *r[1:]] for r in rows[at:]]
            case _:
                del rows[at : at + rng.choice((1, 1, 10**6))]
        rows = [r for r in rows if r] or [[""]]
    return "\n".join("\t".join(row) for row in rows) + "\n"


def mutated_png(data: bytes, rng: random.Random) -> bytes:
    """Changes chunks: their contents (with a checksum that is right), lengths, names, order."""
    chunks, at = [], 8
    while at + 8 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    for _ in range(rng.randint(1, 3)):
        i = rng.randrange(len(chunks))
        name, content = chunks[i]
        match rng.randrange(5):
            case 0:
                chunks[i] = name, mutated_bytes(content, rng)
            case 1:
                sizes = rng.choice((0, 1, 10**6, 2**31 - 1)), rng.choice((0, 1, 65_535, 2**31 - 1))
                chunks[0] = b"IHDR", struct.pack(">II", *sizes) + chunks[0][1][8:]
            case 2:
                chunks[i] = rng.choice((b"IDAT", b"PLTE", b"tRNS", b"iCCP", b"abcd")), content
            case 3:
                chunks.insert(rng.randrange(len(chunks) + 1), chunks[i])
            case _ if len(chunks) > 1:
                del chunks[i]
    said = [
        struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks
    ]
    return data[:8] + b"".join(said)


def mutated_jpeg(data: bytes, rng: random.Random) -> bytes:
    """Changes segments: their lengths and contents, such as the size of the picture."""
    starts = [i for i in range(len(data) - 1) if data[i] == 0xFF and data[i + 1] not in (0, 0xFF)]
    changed = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        at = rng.choice(starts) + rng.choice((1, 2, 3, 4, 5, 6, 7, 8, 9, 12))
        changed[min(at, len(changed) - 1)] = rng.choice((0, 1, 0x7F, 0xC0, 0xC2, 0xFF))
    return bytes(changed)


def one_of(*changes: Callable[[bytes, random.Random], bytes]) -> Callable[..., bytes]:
    """One of these changes, by chance."""
    return lambda data, rng: rng.choice(changes)(data, rng)
