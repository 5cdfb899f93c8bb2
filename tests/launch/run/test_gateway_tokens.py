"""Tokens of the gateway: made once, kept, readable by their owner alone."""

import json
from pathlib import Path

import pytest
from msgspec.structs import replace
from support.buses import robot_at, team_of

from cpcbl_launch.run.gateway.tokens import VARIABLE, GuestTokens, add_guest, tokens_for
from cpcbl_team.config import GuestSettings
from cpcbl_team.errors import InputError


def test_tokens_are_made_once_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "tokens.json"
    made = tokens_for(["r1", "r2"], path, {})
    assert made.keys() == {"r1", "r2"}
    assert made["r1"] != made["r2"]
    assert min(map(len, made.values())) >= 32
    assert path.stat().st_mode & 0o777 == 0o600
    more = tokens_for(["r1", "r2", "r3"], path, {})
    assert more | made == more
    assert tokens_for(["r2"], path, {}) == {"r2": made["r2"]}
    assert json.loads(path.read_text()) == more
    assert [p.name for p in tmp_path.iterdir()] == ["tokens.json"]


def test_the_environment_goes_before_the_file(tmp_path: Path) -> None:
    given = {VARIABLE: "r1=a-long-token, r2=another-token"}
    tokens = tokens_for(["r1", "r2", "r3"], tmp_path / "tokens.json", given)
    assert tokens == {"r1": "a-long-token", "r2": "another-token"}
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("r9=a-long-token", "'r9': write ROBOT=TOKEN,...; there are r1"),
        ("a-long-token", "write ROBOT=TOKEN"),
        ("r1=short", "the token of r1: at least 8 letters and digits"),
        ("r1=with a blank", "the token of r1"),
    ],
)
def test_an_environment_that_cannot_serve_is_refused(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=VARIABLE) as raised:
        tokens_for(["r1"], tmp_path / "tokens.json", {VARIABLE: text})
    assert said in str(raised.value)


def test_a_file_that_others_may_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "tokens.json"
    tokens_for(["r1"], path, {})
    path.chmod(0o640)
    with pytest.raises(InputError, match=r"others may read it \(mode 640\); chmod 600"):
        tokens_for(["r1"], path, {})


@pytest.mark.parametrize("content", [b"", b"[]", b'{"r1": 3}', b"\xff{}", b'{"r1": ""}'])
def test_a_damaged_file_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "tokens.json"
    path.touch(0o600)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"tokens\.json"):
        tokens_for(["r1"], path, {})


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"or set {VARIABLE}"):
        tokens_for(["r1"], tmp_path / "nowhere" / "tokens.json", {})


def test_a_guest_gets_a_token_while_the_gateway_runs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    team, path = team_of(r1=robot_at()), tmp_path / "tokens.json"
    tokens, driven = tokens_for(team.robots, path, {}), {"r1"}
    watch = GuestTokens(team, path, tokens, driven)
    watch.look()
    assert tokens.keys() == driven == {"r1"}
    add_guest("tripod", team, path)
    watch.look()
    assert tokens.keys() == driven == {"r1", "tripod"}
    assert tokens == json.loads(path.read_text())
    path.chmod(0o644)
    path.write_text("{}")
    watch.look()
    assert "others may read it" in caplog.text
    path.chmod(0o600)
    path.write_text(json.dumps({"r1": tokens["r1"]}) + "\n")
    watch.look()
    assert tokens.keys() == {"r1"}


def test_a_guest_needs_a_name_of_its_own_and_a_team_that_admits_guests(tmp_path: Path) -> None:
    team, path = team_of(r1=robot_at()), tmp_path / "tokens.json"
    closed = replace(team, guests=GuestSettings(allowed=False))
    for name, of, said in (("r1", team, "none of r1"), ("a b", team, "32"), ("x", closed, "true")):
        with pytest.raises(InputError, match=f"--guest {name}: .*{said}"):
            add_guest(name, of, path)
    assert not list(tmp_path.iterdir())
