"""Runs with the wheels of ROS 2: the serialization of Fast DDS reads and writes messages.

    python rclpy_partner.py FOLDER

FOLDER holds payloads in files `PACKAGE.TYPE.NUMBER.cdr`. For each of them it writes what Fast DDS
reads (`.json`) and what it writes of that (`.out`). Without anything of this project.
"""

import array
import importlib
import json
import sys
from pathlib import Path
from typing import Any


def plain(value: Any) -> Any:
    """A message of rclpy as dictionaries, lists, numbers and texts."""
    if hasattr(value, "get_fields_and_field_types"):
        return {field: plain(getattr(value, field)) for field in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value[0]
    if isinstance(value, (list, tuple, array.array)) or type(value).__module__ == "numpy":
        return [plain(item) for item in (value.tolist() if hasattr(value, "tolist") else value)]
    return value


def main(folder: Path) -> None:
    from rclpy.serialization import deserialize_message, serialize_message

    for path in sorted(folder.glob("*.cdr")):
        package, name, _ = path.stem.split(".")
        cls = getattr(importlib.import_module(f"{package}.msg"), name)
        message = deserialize_message(path.read_bytes(), cls)
        path.with_suffix(".json").write_text(json.dumps(plain(message)))
        path.with_suffix(".out").write_bytes(serialize_message(message))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
