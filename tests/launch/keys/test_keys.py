"""`cpcbl-team keys` and secured teams, as a user runs them."""

import os
import stat
import subprocess
import sys
import threading
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from support.key_commands import TEAM, keys, refused
from support.keys import again, secured_team
from support.processes import command_line

from cpcbl_agents.extras import install_command
from cpcbl_launch.keys.authority import certificate_facts, issue_certificate, new_authority
from cpcbl_launch.keys.folder import KeyRequest, hosts, plan_actions
from cpcbl_launch.team.file import builtin_path, parse_team
from cpcbl_team.errors import InputError
from cpcbl_transport.security import Member
from cpcbl_transport.topics import Role


def content_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def changed(before: Mapping[str, bytes], after: Mapping[str, bytes]) -> set[str]:
    return {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}


def test_every_member_has_a_folder_with_all_that_it_needs(team_file: Path) -> None:
    said = keys(team_file, "--observer", "tripod", "--observer", "gps")
    members = ["router", "operator", "robot/r1", "robot/r2", "observer/tripod", "observer/gps"]
    assert list(said) == ["ca", *members]
    folder = team_file.parent / "keys"
    for who in members:
        names = {path.name for path in (folder / who).iterdir()}
        assert names >= {"ca.crt", "certificate.crt", "private.key"}
        assert certificate_facts((folder / who / "certificate.crt").read_bytes()).common_name == who
        assert (folder / who / "ca.crt").read_bytes() == (folder / "ca" / "ca.crt").read_bytes()
    assert (folder / ".gitignore").read_text() == "*\n"


def test_only_a_simulated_team_has_a_field(tmp_path: Path, team_file: Path) -> None:
    assert "field" not in keys(team_file)
    path = tmp_path / "demo.toml"
    path.write_text(builtin_path("demo").read_text())
    assert "field" in keys(path)


def test_private_keys_are_their_owners_only(team_file: Path) -> None:
    before = os.umask(0)
    try:
        keys(team_file)
    finally:
        os.umask(before)
    for path in (team_file.parent / "keys").rglob("*"):
        mode = stat.S_IMODE(path.stat().st_mode)
        if path.is_dir():
            assert mode == 0o700, path
        else:
            secret = b"PRIVATE KEY" in path.read_bytes()
            assert mode == (0o600 if secret else 0o644), path
            assert secret is (path.name == "private.key")


def test_a_private_key_is_secret_from_its_first_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Looked at by another thread, as fast as it can, while keys are made again and again."""
    team, loose, stop = secured_team(tmp_path), [], threading.Event()

    def look() -> None:
        while not stop.is_set():
            for path in tmp_path.rglob("*private.key*"):
                try:
                    mode = path.stat().st_mode
                except FileNotFoundError:
                    continue  # it has been put in its place since
                if stat.S_IMODE(mode) != 0o600:
                    loose.append(path)

    looking = threading.Thread(target=look)
    looking.start()
    for _ in range(20):
        again(team, renew=("all",))
    stop.set()
    looking.join()
    assert loose == []


def test_again_changes_nothing_and_adds_what_is_missing(team_file: Path) -> None:
    first = keys(team_file)
    folder = team_file.parent / "keys"
    before = content_of(folder)
    assert {member["deed"] for member in first.values()} == {"made"}
    assert {member["deed"] for member in keys(team_file).values()} == {"kept"}
    assert content_of(folder) == before
    team_file.write_text(TEAM.replace("[robots.r2]", '[robots.r3]\nsource="external"\n[robots.r2]'))
    said = keys(team_file, "--observer", "tripod")
    made = {who for who, member in said.items() if member["deed"] == "made"}
    assert made == {"robot/r3", "observer/tripod"}
    new = {f"{who}/{name}" for who in made for name in ("ca.crt", "certificate.crt", "private.key")}
    assert changed(before, content_of(folder)) == {*new, "router/members.json"}


def test_a_key_that_is_lost_or_of_another_certificate_is_made_again(team_file: Path) -> None:
    keys(team_file)
    folder = team_file.parent / "keys"
    before = content_of(folder)
    (folder / "robot" / "r2" / "private.key").unlink()
    (folder / "robot" / "r1" / "private.key").write_bytes(before["router/private.key"])
    keys(team_file)
    files = ("certificate.crt", "private.key")
    pairs = {f"robot/{robot}/{name}" for robot in ("r1", "r2") for name in files}
    assert changed(before, content_of(folder)) == pairs


def test_renewing_one_leaves_the_others(team_file: Path) -> None:
    keys(team_file)
    before = content_of(team_file.parent / "keys")
    said = keys(team_file, "--renew", "r1", "--days", "2")
    assert said["robot/r1"]["deed"] == "renewed"
    until = datetime.fromisoformat(said["robot/r1"]["valid_until"])
    assert abs(until - datetime.now(UTC) - timedelta(days=2)) < timedelta(minutes=5)
    after = content_of(team_file.parent / "keys")
    assert changed(before, after) == {"robot/r1/certificate.crt", "robot/r1/private.key"}


def test_a_revoked_name_stays_out_until_it_is_renewed_as_another(team_file: Path) -> None:
    keys(team_file, "--observer", "tripod")
    assert keys(team_file, "--revoke", "tripod")["observer/tripod"]["deed"] == "revoked"
    assert keys(team_file)["observer/tripod"]["deed"] == "revoked"
    assert keys(team_file, "--renew", "all")["observer/tripod"]["deed"] == "revoked"
    again = keys(team_file, "--renew", "tripod")["observer/tripod"]
    assert (again["deed"], again["common_name"]) == ("made", "observer/tripod/2")


def test_the_router_can_be_dialled_where_the_team_file_and_the_user_say(team_file: Path) -> None:
    text = (
        TEAM + 'listen = ["tls/0.0.0.0:7447"]\nconnect = ["tls/10.0.0.5:7447", "tls/[fd00::1]:1"]'
    )
    team_file.write_text(text)
    said = keys(team_file, "--host", "router.example")
    usual = ["localhost", "127.0.0.1", "::1", "router"]
    dialled = [*usual, "10.0.0.5", "fd00::1", "router.example"]
    assert said["router"]["hosts"] == dialled
    assert said["robot/r1"]["hosts"] == []
    assert keys(team_file, "--host", "10.0.0.5")["router"]["deed"] == "kept"
    assert "--renew router" in refused("keys", team_file, "--host", "10.0.0.6")
    said = keys(team_file, "--host", "10.0.0.6", "--renew", "router")
    assert said["router"]["hosts"] == [*dialled, "10.0.0.6"]


def test_the_authoritys_key_can_be_kept_elsewhere(team_file: Path) -> None:
    keys(team_file)
    secret = team_file.parent / "keys" / "ca" / "private.key"
    secret.rename(team_file.parent / "safe")
    keys(team_file)  # nothing is to be signed
    assert "authority's key is not here" in refused("keys", team_file, "--observer", "tripod")
    assert not (team_file.parent / "keys" / "observer").exists()
    (team_file.parent / "safe").rename(secret)
    assert keys(team_file, "--observer", "tripod")["observer/tripod"]["deed"] == "made"


def test_an_authority_signs_for_no_longer_than_it_lasts() -> None:
    now = datetime.now(UTC)
    with pytest.raises(InputError, match=r"--days: the authority ends"):
        issue_certificate(new_authority("lab", now), "robot/r1", (), now, timedelta(days=3651))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--renew", "r9"), "--renew r9: nobody has this name; there are: router"),
        (("--revoke", "r9"), "--revoke r9: nobody has this name"),
        (("--observer", "r1"), "--observer r1: is a robot of the team"),
        (("--observer", "a/b"), "--observer a/b: a name has 1 to 32"),
        (("--host", "bücher"), "--host 'bücher': neither"),
        (("--days", "0"), "--days 0: more than 0"),
        (("--output", "/dev/null/keys"), "/dev/null"),
    ],
)
def test_what_cannot_be_made_is_one_line(team_file: Path, more: tuple[str, ...], said: str) -> None:
    assert said in refused("keys", team_file, *more)


def test_without_the_library_the_extra_is_named(team_file: Path) -> None:
    code = (
        "import sys; sys.modules['cryptography'] = None;"
        f"sys.argv = ['cpcbl-team', 'keys', {str(team_file)!r}];"
        "from cpcbl_launch.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert install_command("security") in done.stderr.splitlines()[-1]


def test_a_table_says_what_was_made(team_file: Path) -> None:
    done = command_line("keys", team_file, "--observer", "tripod")
    for word in ("robot/r1", "observer/tripod", "made", "localhost", "private.key"):
        assert word in done.stdout
    rows = [line for line in done.stdout.splitlines() if " made" in line]
    assert len(rows) == 6
    assert max(map(len, rows)) <= 80


def test_no_robot_takes_the_name_of_an_observer() -> None:
    team, tripod = parse_team(TEAM), Member(role=Role.OBSERVER, name="r1")
    with pytest.raises(InputError, match=r"robots\.r1: an observer has this name.*--revoke"):
        plan_actions(team, [tripod], KeyRequest())
    plan = plan_actions(team, [tripod], KeyRequest(revoke=["observer/r1"]))
    actions = {str(member.identity): action for member, action in plan.items()}
    assert (actions["observer/r1"], actions["robot/r1"]) == ("revoked", "made")


def test_a_plan_names_all_that_the_team_needs_and_had() -> None:
    team = parse_team(TEAM)
    known = [Member(role=Role.ROBOT, name="gone"), Member(role=Role.ROBOT, name="r1")]
    plan = plan_actions(team, known, KeyRequest())
    actions = {str(member.identity): action for member, action in plan.items()}
    assert actions["robot/gone"] == actions["robot/r1"] == "kept"
    assert actions["robot/r2"] == actions["router"] == "made"
    assert "0.0.0.0" not in hosts(team, ("0.0.0.0",))
