"""Keys of a team in containers: who can read which."""

import io
import json
import secrets
import shutil
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.docker import TOP, image
from support.key_commands import demo, keys, refused
from support.processes import command_line, cpcbl_team


def services(file: Path) -> dict[str, Any]:
    """What `compose` says of each service of a team."""
    done = command_line("compose", file)
    assert done.returncode == 0, done.stderr
    said: dict[str, Any] = yaml.safe_load(done.stdout)["services"]
    return said


def test_a_container_may_read_its_own_keys_and_no_others(tmp_path: Path) -> None:
    secured = demo(tmp_path, "mtls")
    assert "transport.keys" in refused("compose", secured)
    keys(secured)
    owner = (tmp_path / "keys" / "router" / "private.key").stat()
    for name, service in services(secured).items():
        targets = {mount["target"] for mount in service["volumes"]}
        own = name.replace("robot-", "robot/")
        assert targets == {"/team/mtls.toml", f"/team/keys/{own}"}
        assert all(mount["read_only"] for mount in service["volumes"])
        assert service["user"] == f"{owner.st_uid}:{owner.st_gid}"
        assert not [word for word in service["command"] if "tcp/" in word]
        assert [word for word in service["command"] if word.startswith("tls/")]


def test_containers_of_a_plain_team_have_no_keys(tmp_path: Path) -> None:
    for service in services(demo(tmp_path, "none")).values():
        assert {mount["target"] for mount in service["volumes"]} == {"/team/none.toml"}
        assert "user" not in service


@pytest.mark.docker
@pytest.mark.timeout(400)
def test_a_secured_team_runs_in_containers(tmp_path: Path) -> None:
    secured = demo(tmp_path, "mtls")
    keys(secured)
    done = cpcbl_team(
        *("up", secured, "--containers", "--image", image(), "--robots", "observer,patrol"),
        *("--duration", 12, "--json"),
        timeout_s=380.0,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    for name in ("observer", "patrol"):
        assert report["robots"][name]["samples"] > 0, name
        assert report["robots"][name]["lost_at_end"] == "", name


def checkout_with_keys(folder: Path) -> Path:
    """A part of the sources, with a secured team's file and keys among them; where the keys are."""
    for name in (".gitignore", ".dockerignore"):
        shutil.copy(TOP / name, folder)
    teams = folder / "launch" / "cpcbl_launch" / "teams"
    shutil.copytree(TOP / "launch" / "cpcbl_launch" / "teams", teams)
    keys(demo(teams, "mtls"))
    return teams / "keys"


def test_keys_do_not_get_into_a_repository(tmp_path: Path) -> None:
    made = checkout_with_keys(tmp_path)
    listing = ["git", "ls-files", "--others", "--exclude-standard"]
    subprocess.run(["git", "init", "--quiet", tmp_path], check=True)
    for ignore in (made / ".gitignore", tmp_path / ".gitignore"):  # either will do
        done = subprocess.run(listing, cwd=tmp_path, capture_output=True, text=True, check=True)
        assert "launch/cpcbl_launch/teams/mtls.toml" in done.stdout
        assert "private.key" not in done.stdout
        ignore.unlink()
    done = subprocess.run(listing, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "private.key" in done.stdout


@pytest.mark.docker
def test_keys_do_not_get_into_an_image(tmp_path: Path) -> None:
    """Of all that the builder is given, as an image that takes everything."""
    checkout_with_keys(tmp_path)
    (tmp_path / "Everything").write_text("FROM scratch\nCOPY . /\n")
    name = f"cpcbl-keys-{secrets.token_hex(4)}"
    build = ("docker", "build", "--quiet", "--tag", name, "--file", str(tmp_path / "Everything"))
    subprocess.run([*build, str(tmp_path)], check=True, capture_output=True)
    try:
        subprocess.run(
            ["docker", "create", "--name", name, name, "nothing"], check=True, capture_output=True
        )
        exported = subprocess.run(["docker", "export", name], check=True, capture_output=True)
    finally:
        subprocess.run(["docker", "rm", name], check=False, capture_output=True)
        subprocess.run(["docker", "rmi", name], check=False, capture_output=True)
    with tarfile.open(fileobj=io.BytesIO(exported.stdout)) as tar:
        names = tar.getnames()
    assert "launch/cpcbl_launch/teams/mtls.toml" in names
    assert not [name for name in names if "keys" in name.split("/")]
