"""Converts a merged run with Rerun's command line, and reads the result with Rerun's reader.

    python rerun_partner.py RUN.mcap RUN.rrd

Prints, by entity, how many rows have which of Rerun's components, as JSON.
"""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

from rerun.chunk import RrdReader


def main(run: Path, converted: Path) -> None:
    program = Path(sys.executable).parent / "rerun"
    command = [str(program), "mcap", "convert", str(run), "-o", str(converted)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    rows: dict[str, Counter[str]] = {}
    for chunk in RrdReader(converted).stream():
        batch = chunk.to_record_batch()
        found = rows.setdefault(chunk.entity_path, Counter())
        for name in batch.schema.names:
            found[name] += batch.num_rows
    sys.stdout.write(json.dumps(rows))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
