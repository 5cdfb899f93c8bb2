"""Damaged runs: merged files, and folders with parts of which one is damaged."""

import json
import random
import shutil
from functools import cache
from pathlib import Path

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from fuzz.mutations import mutated_bytes, mutated_tree
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from support.simulated import record_run

from cpcbl_launch.recordings.merge import merge
from cpcbl_launch.recordings.summary import summarize
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.reporting.recording import TEAM
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.views.report.page import report_page

RECORDED_S = 1.0
MESSAGES = 80  # of a merged file that is written anew


@cache
def whole_run(folder: Path) -> Path:
    """The folder of a whole run, with its merged file."""
    run = folder / "whole-run"
    record_run(run, load_team(builtin_path("demo")), 1, RECORDED_S, with_bus=True)
    merge(run)
    return run


def _picture(data: bytes) -> bytes:
    """What is on a topic of a camera."""
    return CompressedImage(data=data, format="jpeg").SerializeToString()


def write_merged(folder: Path, rng: random.Random) -> Path:
    """A merged file with damaged bytes, or with damaged messages and schemas."""
    path, whole = folder / "merged.mcap", whole_run(folder) / "run.mcap"
    if rng.random() < 0.3:
        path.write_bytes(mutated_bytes(whole.read_bytes(), rng))
        return path
    with whole.open("rb") as file:
        reader = make_reader(file)
        rows = rng.sample(list(reader.iter_messages()), MESSAGES)
        (team,) = [a.data for a in reader.iter_attachments()]
    with path.open("wb") as file:
        writer = Writer(file, 4000, rng.choice(list(CompressionType)))
        writer.start(profile="cpcbl", library="fuzz")
        writer.add_attachment(0, 0, TEAM, "application/json", team)
        for schema, channel, message in rows:
            data, number = message.data, 0
            if rng.random() < 0.01:
                if channel.message_encoding == "json":
                    tree = [json.loads(data)]
                    mutated_tree(tree, rng)
                    data = json.dumps(tree[0] if tree else None).encode()
                else:
                    data = mutated_bytes(data, rng)
            if schema is not None and rng.random() < 0.98:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
            topic = channel.topic
            if topic == "/log":  # a run of robots without cameras
                topic, data = "/cameras/scout", mutated_bytes(_picture(data), rng)
            own = writer.register_channel(topic, channel.message_encoding, number)
            writer.add_message(own, message.log_time, data, message.log_time)
        writer.finish()  # type: ignore[no-untyped-call]
    if rng.random() < 0.2:
        path.write_bytes(mutated_bytes(path.read_bytes(), rng))
    return path


def read_merged(path: Path) -> None:
    """As `calibrate`, `report` and `merge` do."""
    read_recording(path)
    report_page([summarize(path)])
    merge(path, path.with_name("again.mcap"))


def write_run(folder: Path, rng: random.Random) -> Path:
    """The folder of a run, in which one file is damaged, is foreign, or is missing."""
    run, whole = folder / "run", whole_run(folder)
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree(whole, run)
    (run / "run.mcap").unlink()
    parts = sorted(path for path in run.rglob("*") if path.is_file())
    path = rng.choice(parts)
    match rng.randrange(5):
        case 0:
            path.unlink()
        case 1:
            path.write_bytes(rng.choice(parts).read_bytes())
        case _:
            path.write_bytes(mutated_bytes(path.read_bytes(), rng))
    return run


def read_run(path: Path) -> None:
    """As `merge` and `report` do; what is missing is said in lines for people."""
    merged = merge(path)
    assert all(remark.isprintable() for remark in merged.remarks)
    report_page([summarize(path)])
