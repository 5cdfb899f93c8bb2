"""The guard that lets no process outlive its tests, and signals of background jobs."""

import re
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
LEAKS = """
import subprocess, sys
PARENT = '''
import subprocess, sys
silent = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
sleeper = [sys.executable, "-c", "import time; time.sleep(600)"]
print(subprocess.Popen(sleeper, start_new_session=True, **silent).pid)
'''
def test_leaks():
    orphan = subprocess.run([sys.executable, "-c", PARENT], capture_output=True, text=True)
    assert False, f"orphan {orphan.stdout.strip()}."
"""
SIGNALS = """
import subprocess, sys
def test_children_react_to_signals():
    program = "from signal import *; print(getsignal(SIGINT), getsignal(SIGHUP))"
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout
    assert "SIG_IGN" not in shown, shown
"""


def run_test(folder: Path, text: str) -> "subprocess.CompletedProcess[str]":
    """Runs one test file beneath the project's own conftest."""
    (folder / "conftest.py").write_text((ROOT / "tests" / "conftest.py").read_text())
    (folder / "test_one.py").write_text(text)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(folder)]
    options = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(ROOT)]
    return subprocess.run([*command, *options], capture_output=True, text=True, check=False)


def test_a_process_that_a_failing_test_leaves_is_ended_and_named(tmp_path: Path) -> None:
    ran = run_test(tmp_path, LEAKS)
    assert "1 failed, 1 error" in ran.stdout
    assert "processes that outlived their tests" in ran.stdout
    pid = re.findall(r"AssertionError: orphan (\d+)\.$", ran.stdout, re.MULTILINE)[0]
    assert subprocess.run(["ps", "-p", pid], capture_output=True, check=False).returncode


def test_what_a_background_job_ignores_reaches_the_children_of_tests(tmp_path: Path) -> None:
    ignored = [signal.SIGINT, signal.SIGHUP]
    before = [signal.signal(number, signal.SIG_IGN) for number in ignored]
    try:
        ran = run_test(tmp_path, SIGNALS)
    finally:
        for number, handler in zip(ignored, before, strict=True):
            signal.signal(number, handler)
    assert ran.returncode == 0, ran.stdout
