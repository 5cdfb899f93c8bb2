"""The examples of docs/wire_format.md: what it shows is what is taken, sent and run."""

import json
import re
import tomllib
from pathlib import Path

import msgspec
from support.buses import SECOND

from cpcbl_team.config import GatewaySettings
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sightings
from cpcbl_transport import topics
from cpcbl_transport.decoding import decode
from cpcbl_transport.json_messages import encode_json
from cpcbl_transport.messages import Frame, Pose

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "wire_format.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_python_of_the_page_is_that_of_the_programs_that_run() -> None:
    programs = [
        (DOCS / name).read_text(encoding="utf-8").replace("Driver(team, robot)", "Driver(FILE)")
        for name in ("external_driver.py", "pose_consumer.py")
    ]
    driver, consumer = blocks("python")
    shown = driver.replace('Driver("team.toml", "r1")', "Driver(FILE)").split("\n\n")
    assert all(part.strip() in programs[0] for part in shown)
    assert consumer.splitlines()[0] in programs[1]
    assert consumer.splitlines()[2].replace('"team.toml", "r1"', "team, robot") in programs[1]


def test_the_json_inputs_of_the_page_are_taken() -> None:
    lines = blocks("json")[0].splitlines()
    keys = [f"in/r1/{name}" for name in ("odometry", "sightings", "position", "initial_pose")]
    kinds = [type(decode(key, line.encode())) for key, line in zip(keys, lines, strict=True)]
    assert kinds == [Odometry, Sightings, Position, InitialPose]


def test_the_json_output_of_the_page_is_that_of_a_pose() -> None:
    shown = json.loads(blocks("json")[1])
    rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    sent = json.loads(encode_json(Pose("r1", SECOND, 1.0, 2.0, 0.5, rows)))
    assert list(shown) == list(sent)
    assert [len(row) for row in shown["covariance"]] == [3, 3, 3]


def test_the_table_of_messages_has_every_field() -> None:
    for kind in (Odometry, Sightings, Position, InitialPose, Frame, Pose):
        row = next(
            line for line in PAGE.splitlines() if f"| `{topics.topic_of(kind).key}` |" in line
        )
        for field in kind.__struct_fields__:
            assert f"`{field}`" in row


def test_the_settings_of_the_page_are_the_defaults() -> None:
    (table,) = (tomllib.loads(text)["gateway"] for text in blocks("toml"))
    assert msgspec.convert(table, GatewaySettings) == GatewaySettings()
    assert table.keys() == {*GatewaySettings.__struct_fields__}
