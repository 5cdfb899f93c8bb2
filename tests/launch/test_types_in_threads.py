"""Types that several threads meet at the same moment, for the first time in a process.

msgspec describes a type at its first use; two threads that do that at once crash the process. So
each program here runs in processes of its own, whose threads take turns very often.
"""

import subprocess
import sys

import pytest
from support.sweeps import sampled

from cpcbl_launch.team.file import builtin_path

PROCESSES = 6  # without care four of five crash with a team file, one of six with JSON
PROGRAM = """
import sys, threading
from pathlib import Path
{imports}

def run():
    barrier.wait()
    answers.append(repr({expression}))

sys.setswitchinterval(1e-6)
barrier, answers = threading.Barrier(4), []
threads = [threading.Thread(target=run) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert len(answers) == 4 and len(set(answers)) == 1, answers
"""
TEAM = f"Path({str(builtin_path('demo'))!r})"
SEEN = """{"stamp_ns": 1, "sightings": []}"""
WORK = {
    "a team file": ("from cpcbl_launch.team.file import load_team", f"load_team({TEAM})"),
    "the team of a client": ("from cpcbl_client.team import read_team", f"read_team({TEAM})"),
    "an input as JSON": (
        "from cpcbl_transport.json_messages import decode_json\n"
        "from cpcbl_transport.messages import Sightings\n"
        "from cpcbl_transport.topics import topic_of",
        f"decode_json(b'{SEEN}', topic_of(Sightings))",
    ),
    "an output as JSON": (
        "from cpcbl_transport.json_messages import encode_json\n"
        "from cpcbl_transport.messages import Truth, Truths",
        "encode_json(Truths(1, (Truth('scout', 1.0, 2.0, 0.5),)))",
    ),
}


@pytest.mark.parametrize("work", sampled(WORK, ["an input as JSON"]))
def test_threads_that_meet_a_type_at_once_get_the_same(work: str) -> None:
    imports, expression = WORK[work]
    program = PROGRAM.format(imports=imports, expression=expression)
    for _ in range(PROCESSES):
        ran = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=False
        )
        assert ran.returncode == 0, ran.stderr
