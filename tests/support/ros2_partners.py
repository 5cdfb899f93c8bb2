"""Independent implementations of ROS 2 that a test talks to: rclpy and dora-rs, in their own venv.

`make test-ros2` installs them (tests/ros2/partners.txt) and names their venv in CPCBL_ROS2.
"""

import json
import os
import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from cpcbl_transport.ros2.definitions import APRILTAG_AND_VISION
from cpcbl_transport.ros2.names import Distribution

HERE = Path(__file__).parents[1] / "ros2"
DOMAIN = 7
NOT_IN_WHEELS = {
    **APRILTAG_AND_VISION,
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
HUMBLES = {
    "sensor_msgs/msg/Range": "std_msgs/Header header\nuint8 radiation_type\nfloat32 field_of_view\n"
    "float32 min_range\nfloat32 max_range\nfloat32 range\n"
}
"""Types that had another definition in Humble than in the wheels."""
PACKAGE = """<package format="3"><name>{}</name><version>1.0.0</version><description>.</description>
<maintainer email="none@example.org">.</maintainer><license>.</license>
<depend>std_msgs</depend><depend>geometry_msgs</depend></package>"""


def wheels() -> Path:
    """The venv with the wheels of ROS 2 and dora-rs."""
    return Path(os.environ["CPCBL_ROS2"]).absolute()


def run_partner(
    script: str, *arguments: object, prefix: Path | None = None
) -> "subprocess.CompletedProcess[str]":
    """Runs a script of tests/ros2 with the partners' Python to its end."""
    ran = subprocess.run(
        [wheels() / "bin/python", HERE / script, *map(str, arguments)],
        env=_environment(prefix),
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return ran


def type_hash_in(prefix: Path, name: str) -> str:
    """The type hash that an installation of ROS 2 has for a type."""
    package, kind, short = name.split("/")
    described = json.loads((prefix / "share" / package / kind / f"{short}.json").read_text())
    hashes = {entry["type_name"]: entry["hash_string"] for entry in described["type_hashes"]}
    return str(hashes[name])


def write_prefix(prefix: Path, distribution: Distribution = Distribution.KILTED) -> None:
    """Writes an installation of ROS 2 with what the wheels lack, or have in another definition;
    ROS 2's own generator computes the type hashes."""
    humbles = HUMBLES if distribution is Distribution.HUMBLE else {}
    for name, text in {**NOT_IN_WHEELS, **humbles}.items():
        package, kind, short = name.split("/")
        folder = prefix / "share" / package / kind
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{short}.msg").write_text(text)
        (folder.parent / "package.xml").write_text(PACKAGE.format(package))
    run_partner("interfaces_partner.py", wheels(), prefix)


@contextmanager
def dora_echo(
    router: str, distribution: Distribution, topics: Sequence[tuple[str, str]], prefix: Path
) -> Iterator[list[str]]:
    """A node of dora-rs that sends each topic (name, type) back as TOPIC_echo; gives the lines that
    it prints. At its end its log, which names the tokens that it saw, is the line after `--`."""
    config = prefix / "session.json5"
    multicast = {"multicast": {"enabled": False}}
    endpoints = {"endpoints": [router]}
    config.write_text(json.dumps({"mode": "client", "connect": endpoints, "scouting": multicast}))
    compatibility = "rep2016" if distribution.has_type_hashes else "humble"
    words = [f"{topic}={kind.replace('/msg/', '/')}" for topic, kind in topics]
    with (prefix / "dora.log").open("w+") as log:
        process = subprocess.Popen(
            [wheels() / "bin/python", HERE / "dora_partner.py", compatibility, config, *words],
            env=_environment(prefix),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        assert process.stdin
        assert process.stdout
        lines: list[str] = []
        reader = threading.Thread(target=lambda: lines.extend(process.stdout or ()))
        try:
            first = process.stdout.readline()
            assert first == "ready\n", (prefix / "dora.log").read_text()[:2000]
            reader.start()
            yield lines
        finally:
            process.stdin.close()
            process.wait(30)
            if reader.is_alive():
                reader.join()
            process.stdout.close()
            lines.append("--")
            lines.append((prefix / "dora.log").read_text())


def _environment(prefix: Path | None) -> dict[str, str]:
    prefixes = [str(wheels()), *([str(prefix)] if prefix else [])]
    return {
        **os.environ,
        "AMENT_PREFIX_PATH": os.pathsep.join(prefixes),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_DOMAIN_ID": str(DOMAIN),  # dora's `domain_id=` leaves its keys in domain 0
        "DORA_ROS2_ZENOH_TRACE": "1",
    }
