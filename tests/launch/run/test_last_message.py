"""What the supervisor says of a process that ended: its last words, not the tail of a traceback."""

import subprocess
import sys

import pytest

from cpcbl_launch.run.processes import last_message

SEVERAL_LINES = "raise ValueError('the frame is too large\\n> details:\\n> \\n;\\n')"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "it printed nothing"),
        ("\n  \n;\n", "it printed nothing"),
        ("r1: started\nr1: team.toml: no such file\n", "r1: team.toml: no such file"),
        ("r1: started\n\n;\n", "r1: started"),
    ],
)
def test_the_last_line_with_a_word_in_it(text: str, said: str) -> None:
    assert last_message(text) == said


def test_the_exception_of_a_traceback_of_several_lines() -> None:
    done = subprocess.run([sys.executable, "-c", SEVERAL_LINES], capture_output=True, text=True)
    assert done.returncode == 1
    assert last_message("r1: started\n" + done.stderr) == "ValueError: the frame is too large"
