"""Old and new programs on one bus: a message keeps its bytes, and both understand each other."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_type_hints

import msgspec
import pytest
from support import messages as samples

from cpcbl_team.config import OdometrySettings, PositionSensor, RobotSettings, SensorSettings, Start
from cpcbl_team.inputs import Belief, Fix, LandmarkBelief
from cpcbl_transport import topics
from cpcbl_transport.compact import decode_help, encode_help
from cpcbl_transport.messages import (
    VERSION,
    Help,
    Join,
    Message,
    Pose,
    Refusal,
    Status,
    Tagged,
    Track,
    decode_tagged,
    encode,
    model_from_settings,
    settings_from_model,
)

BY_TYPE: dict[Any, Tagged] = {type(m): m for m in samples.VALID}
HELP: dict[Any, Help] = {
    Belief: samples.BELIEF,
    Fix: samples.FIX,
    LandmarkBelief: samples.LANDMARK,
}
GOLDEN: dict[str, str] = json.loads(
    Path(__file__).with_name("golden_messages.json").read_text(encoding="utf-8")
)
"""The bytes of each sample by tag, as commit 195008d wrote them."""
NEW = ("new", {"and": ["nested"]}, 3.5)
KEYS = {
    Belief: topics.BELIEF.at(tier=3, robot="r1"),
    Fix: topics.FIX.at(robot="r2", tier=3, observer="r1"),
    LandmarkBelief: topics.LANDMARK.at(landmark="oak", tier=3, robot="r1"),
}

of_every_tagged_type = pytest.mark.parametrize("kind", get_args(Tagged))
of_every_help_type = pytest.mark.parametrize("kind", get_args(Help))


def packed(tree: Any) -> bytes:
    """A payload as another program writes it."""
    return bytes([VERSION]) + msgspec.msgpack.encode(tree)


def newer(part: Any) -> Any:
    """What a newer program writes: every struct has more fields, every map of structs more keys."""
    if isinstance(part, tuple):
        return [newer(item) for item in part]
    if not isinstance(part, msgspec.Struct):
        return part
    config, fields = part.__struct_config__, part.__struct_fields__
    values = [newer(getattr(part, name)) for name in fields]
    if not config.array_like:
        return {**dict(zip(fields, values, strict=True)), "new": NEW, "newer": None}
    tag = () if config.tag is None else (config.tag,)
    return [*tag, *values, *NEW]


def older(part: Any) -> Any:
    """What an older program writes: every struct has only its required fields."""
    if isinstance(part, tuple):
        return [older(item) for item in part]
    if not isinstance(part, msgspec.Struct):
        return part
    required = [f.name for f in msgspec.structs.fields(part) if f.required]
    values = [older(getattr(part, name)) for name in required]
    if not part.__struct_config__.array_like:
        return dict(zip(required, values, strict=True))
    tag = part.__struct_config__.tag
    return [*(() if tag is None else (tag,)), *values]


def with_defaults(part: Any) -> Any:
    """The message as a newer reader understands the older one."""
    if isinstance(part, tuple):
        return tuple(with_defaults(item) for item in part)
    if not isinstance(part, msgspec.Struct):
        return part
    required = [f.name for f in msgspec.structs.fields(part) if f.required]
    return type(part)(**{name: with_defaults(getattr(part, name)) for name in required})


def structs_in(hint: Any) -> Iterator[type[msgspec.Struct]]:
    """All struct types that a type mentions, however deep."""
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        yield hint
        for inner in get_type_hints(hint).values():
            yield from structs_in(inner)
    elif isinstance(hint, UnionType) or get_args(hint):
        for inner in get_args(hint):
            yield from structs_in(inner)


def structs_of(part: Any) -> Iterator[type[msgspec.Struct]]:
    """The types of all structs in a message, however deep."""
    if isinstance(part, tuple):
        for item in part:
            yield from structs_of(item)
    elif isinstance(part, msgspec.Struct):
        yield type(part)
        for name in part.__struct_fields__:
            yield from structs_of(getattr(part, name))


def test_the_samples_hold_every_struct_of_the_wire() -> None:
    held = set(structs_of(tuple(BY_TYPE.values()) + tuple(HELP.values())))
    assert held == set(structs_in(Message))


@of_every_tagged_type
def test_an_older_reader_understands_a_newer_message(kind: type[Tagged]) -> None:
    message = BY_TYPE[kind]
    assert decode_tagged(packed(newer(message))) == message


@of_every_tagged_type
def test_a_newer_reader_understands_an_older_message(kind: type[Tagged]) -> None:
    message = BY_TYPE[kind]
    assert decode_tagged(packed(older(message))) == with_defaults(message)


def test_a_newer_status_may_have_new_counts() -> None:
    status = msgspec.structs.replace(samples.STATUS, counts={"odometry": 7, "a new count": 2})
    assert decode_tagged(encode(status)) == status


@of_every_help_type
def test_an_older_reader_refuses_a_longer_fix_or_belief_with_a_reason(kind: type[Help]) -> None:
    """Fixes and beliefs have no room for more fields: another layout needs another version."""
    payload = encode_help(HELP[kind])
    assert decode_help(KEYS[kind], payload) is not Refusal.GARBAGE
    assert decode_help(KEYS[kind], payload + b"more") is Refusal.GARBAGE
    later_version = bytes([VERSION + 1]) + payload[1:]
    assert decode_help(KEYS[kind], later_version) is Refusal.VERSION


@pytest.mark.parametrize("kind", [t for t in get_args(Tagged) if t is not Join])
def test_the_bytes_of_a_message_are_frozen(kind: type[Tagged]) -> None:
    assert encode(BY_TYPE[kind]).hex() == GOLDEN[str(kind.__struct_config__.tag)]


@pytest.mark.parametrize(
    ("message", "name"),
    [
        (samples.BELIEF, "belief"),
        (samples.FIX, "fix"),
        (samples.HEADED_FIX, "fix with heading"),
        (samples.LANDMARK, "landmark"),
    ],
)
def test_the_bytes_of_a_fix_and_a_belief_are_frozen(message: Help, name: str) -> None:
    assert encode_help(message).hex() == GOLDEN[name]


def test_a_status_and_a_pose_without_unconfirmed_are_still_understood() -> None:
    for name, due in (("status", samples.CONFIRMED_STATUS), ("pose", samples.CONFIRMED_POSE)):
        assert decode_tagged(bytes.fromhex(GOLDEN[f"{name} without unconfirmed"])) == due


def test_a_status_without_places_is_still_understood() -> None:
    golden = bytes.fromhex(GOLDEN["status without places"])
    assert decode_tagged(golden) == samples.SURVEYED_STATUS


@pytest.mark.parametrize(
    ("name", "due"),
    [
        ("status", samples.FIELD_STATUS),
        ("track", samples.FIELD_TRACK),
        ("pose", samples.FIELD_POSE),
    ],
)
def test_a_message_without_frame_is_in_that_of_the_field(name: str, due: Tagged) -> None:
    message = decode_tagged(bytes.fromhex(GOLDEN[f"{name} without frame"]))
    assert message == due
    assert isinstance(message, Status | Track | Pose)
    assert message.frame == ""


def test_a_status_without_inputs_is_still_understood() -> None:
    assert decode_tagged(bytes.fromhex(GOLDEN["status without inputs"])) == samples.OLDER_STATUS


def test_a_join_of_the_first_releases_is_still_understood() -> None:
    """Those wrote whole tables of the team file, with keys that the field does not need."""
    assert decode_tagged(bytes.fromhex(GOLDEN["join"])) == samples.JOIN


def test_a_model_holds_what_the_settings_say() -> None:
    settings = RobotSettings(
        start=Start(x_m=1.0, y_m=-2.0, heading_deg=30.0, sigma_m=0.1),
        sensor=SensorSettings(range_share=0.1, field_of_view_deg=360.0, correlation_s=2.0),
        odometry=OdometrySettings(distance_scale=0.9, crawl_sigma_m_per_sqrt_s=0.01, moves=False),
        position_sensor=PositionSensor(sigma_m=0.5),
    )
    model = model_from_settings(settings)
    assert model is not None
    assert settings_from_model(model) == settings


@pytest.mark.parametrize(
    "settings", [RobotSettings(), RobotSettings(source="external", start=Start(x_m=0.0, y_m=0.0))]
)
def test_only_a_simulated_robot_with_a_start_has_a_model(settings: RobotSettings) -> None:
    assert model_from_settings(settings) is None


def test_the_defaults_of_a_model_are_those_of_the_settings() -> None:
    settings = RobotSettings(start=Start(x_m=1.0, y_m=2.0), position_sensor=PositionSensor())
    assert model_from_settings(settings) == samples.MODEL
