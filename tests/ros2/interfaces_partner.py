"""Runs with the wheels of ROS 2: its own generator computes the type hashes of definitions.

    python interfaces_partner.py WHEELS PREFIX

PREFIX holds definitions as an installation of ROS 2 does: `share/PACKAGE/msg/TYPE.msg`. Beside each
of them its type description with its hash is written (`TYPE.json`); WHEELS is where the packages
are that they depend on. Without anything of this project.
"""

import json
import sys
import tempfile
from pathlib import Path

from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_type_description import generate_type_hash


def main(wheels: Path, prefix: Path) -> None:
    known = [folder for folder in (wheels / "share").iterdir() if (folder / "msg").is_dir()]
    for package in sorted((prefix / "share").iterdir()):
        with tempfile.TemporaryDirectory() as scratch:
            idl_folder = Path(scratch) / "idl"
            names = []
            for message in sorted((package / "msg").glob("*.msg")):
                source = message.relative_to(package)
                convert_msg_to_idl(package, package.name, source, idl_folder / "msg")
                names.append(f"{idl_folder}:{source.with_suffix('.idl')}")
            arguments = {
                "package_name": package.name,
                "output_dir": str(package),
                "idl_tuples": names,
                "include_paths": [f"{folder.name}:{folder}" for folder in known],
            }
            path = Path(scratch) / "arguments.json"
            path.write_text(json.dumps(arguments))
            generate_type_hash(str(path))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
