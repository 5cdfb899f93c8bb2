"""`cpcbl-team keys` and secured teams, as a user runs them."""

import io
import json
import os
import secrets
import shutil
import signal
import stat
import subprocess
import sys
import tarfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.buses import Subscription, wait_until
from support.docker import TOP, image
from support.keys import OPERATOR, R1, again, router_of, secured_team, session, with_credentials
from support.processes import cpcbl_team, eventually, patient_up
from typer.testing import CliRunner

from cpcbl_team.errors import InputError
from cpcbl_launch.app import app
from cpcbl_launch.keys.authority import certificate_facts, issue_certificate, new_authority
from cpcbl_launch.keys.plan import KeyAction, hosts, plan_actions
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.team_file import TeamFileError, builtin_path, load_team, parse_team
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.messages import Drive, Refusal, Status, Track, encode
from cpcbl_transport.decoding import decode
from cpcbl_transport.security import Member
from cpcbl_transport.topics import Qos, Role
from cpcbl_transport.zenoh_bus import BusError

SECURED = '\n[transport]\nsecurity = "mtls"\n'
TEAM = f"""
name = "lab"
[robots.r1]
source = "external"
[robots.r2]
source = "external"
{SECURED}"""


@pytest.fixture
def team_file(tmp_path: Path) -> Path:
    path = tmp_path / "team.toml"
    path.write_text(TEAM)
    return path


def content_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def changed(before: Mapping[str, bytes], after: Mapping[str, bytes]) -> set[str]:
    return {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}


def keys(file: Path, *more: object) -> dict[str, dict[str, Any]]:
    """What `keys FILE MORE --json` says, by member."""
    done = CliRunner().invoke(app, [str(word) for word in ("keys", file, *more, "--json")])
    assert done.exit_code == 0, done.output
    return {member["who"]: member for member in json.loads(done.stdout)}


def refused(*command: object) -> str:
    """The one line with which a command ends that cannot be done."""
    done = cpcbl_team(*command)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("cpcbl-team: ")]
    return line


# What lies in the folder ------------------------------------------------------------------------


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


def test_only_a_simulated_team_has_a_field(tmp_path: Path) -> None:
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
    assert "pip install 'cpcbl-team[security]'" in done.stderr.splitlines()[-1]


def test_a_table_says_what_was_made(team_file: Path) -> None:
    done = cpcbl_team("keys", team_file, "--observer", "tripod")
    for word in ("robot/r1", "observer/tripod", "made", "localhost", "private.key"):
        assert word in done.stdout
    rows = [line for line in done.stdout.splitlines() if " made" in line]
    assert len(rows) == 6
    assert max(map(len, rows)) <= 80


def test_no_robot_takes_the_name_of_an_observer() -> None:
    team, tripod = parse_team(TEAM), Member(role=Role.OBSERVER, name="r1")
    with pytest.raises(InputError, match=r"robots\.r1: an observer has this name.*--revoke"):
        plan_actions(team, [tripod])
    steps = plan_actions(team, [tripod], revoke=["observer/r1"])
    deeds = {str(step.member.identity): step.action for step in steps}
    assert (deeds["observer/r1"], deeds["robot/r1"]) == (KeyAction.REVOKED, KeyAction.MADE)


def test_a_plan_names_all_that_the_team_needs_and_had() -> None:
    team = parse_team(TEAM)
    known = [Member(role=Role.ROBOT, name="gone"), Member(role=Role.ROBOT, name="r1")]
    deeds = {str(step.member.identity): step.action for step in plan_actions(team, known)}
    assert deeds["robot/gone"] is deeds["robot/r1"] is KeyAction.KEPT
    assert deeds["robot/r2"] is deeds["router"] is KeyAction.MADE
    assert "0.0.0.0" not in hosts(team, ("0.0.0.0",))


# The team file ----------------------------------------------------------------------------------


def test_keys_are_looked_for_beside_the_team_file(team_file: Path) -> None:
    team = load_team(team_file)
    assert team.transport.keys == str(team_file.parent / "keys")
    assert team.transport.connect == ("tls/127.0.0.1:7447",)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TEAM + 'connect = ["tcp/a:1"]', "transport.connect: 'tcp/a:1'.*mtls.*tls/a:1"),
        (TEAM + 'listen = ["quic/a:1"]', "transport.listen: 'quic/a:1'.*mtls.*tls/a:1"),
        (TEAM.replace("mtls", "none") + 'connect = ["tls/a:1"]', "tls/a:1.*mtls.*tcp/a:1"),
        (TEAM.replace("mtls", "tls"), "transport.security"),
    ],
)
def test_endpoints_go_with_the_security(text: str, said: str) -> None:
    with pytest.raises(TeamFileError, match=said):
        parse_team(text)


# Processes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    [
        ("up", "{file}", "--duration", "1"),
        ("robot", "r1", "--team", "{file}"),
        ("traffic", "{file}"),
        ("router", "{file}"),
        ("field", "--team", "{file}"),
    ],
    ids=lambda words: words[0],
)
def test_absent_keys_end_every_command_with_one_line(
    team_file: Path, command: tuple[str, ...]
) -> None:
    line = refused(*(word.format(file=team_file) for word in command))
    assert str(team_file.parent / "keys") in line
    assert "transport.keys" in line
    assert "cpcbl-team keys" in line


def test_plain_endpoints_end_every_command_with_one_line(team_file: Path) -> None:
    keys(team_file)
    plain = ("--connect", "tcp/127.0.0.1:1")
    for command in (("robot", "r1", "--team", team_file), ("traffic", team_file)):
        line = refused(*command, *plain)
        assert "tcp/127.0.0.1:1" in line
        assert "tls/127.0.0.1:1" in line


@contextmanager
def running(*command: object) -> Iterator["subprocess.Popen[str]"]:
    """A command beside the test, which ends it, and well."""
    process = subprocess.Popen([*PROGRAM, *map(str, command)], stdout=subprocess.PIPE, text=True)
    try:
        yield process
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 0
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def demo(folder: Path, security: str) -> Path:
    """The demonstration, helping from its second second on."""
    path = folder / f"{security}.toml"
    text = builtin_path("demo").read_text().replace("after_s = 10.0", "after_s = 2.0")
    path.write_text(f'{text}\n[transport]\nsecurity = "{security}"\n')
    return path


def test_a_secured_team_does_as_well_as_one_without_a_network(tmp_path: Path) -> None:
    """Both with the same noise; an operator watches the secured one."""
    plain, secured = demo(tmp_path, "none"), demo(tmp_path, "mtls")
    keys(secured)
    endpoint = free_endpoint("tls")
    secured.write_text(secured.read_text() + f'listen = ["{endpoint}"]\n')
    run = ("--duration", 10, "--seed", 5, "--json")
    watch = ("traffic", secured, "--connect", endpoint, "--wait", 60, "--json")
    with running(*watch) as watching:
        done = patient_up(secured, *run)
        watching.send_signal(signal.SIGINT)
        seen = json.loads(watching.communicate(timeout=20)[0])
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    other = json.loads(cpcbl_team("simulate", plain, *run).stdout)
    assert report["restarts"] == {}
    assert set(seen["robots"]) == set(report["robots"])
    for name, robot in report["robots"].items():
        assert robot["lost_at_end"] == "", name
        assert robot["samples"] > 0.5 * other["robots"][name]["samples"], name
    assert report["robots"]["observer"]["messages_sent"] > 20
    assert report["team"]["position_rmse_m"] < 1.5 * other["team"]["position_rmse_m"] + 0.02
    assert report["team"]["inside_3_sigma"] > 0.9


def test_an_observer_joins_a_secured_team_with_its_own_certificate(tmp_path: Path) -> None:
    secured, endpoint = demo(tmp_path, "mtls"), free_endpoint("tls")
    secured.write_text(secured.read_text() + f'listen = ["{endpoint}"]\n')
    keys(secured, "--observer", "tripod")
    join = ("--team", secured, "--connect", endpoint, "--at", "4.5,0,90", "--json")
    assert "observer/stranger" in refused("observer", "stranger", *join)
    with running("up", secured, "--duration", 20, "--json") as team:
        visited = json.loads(cpcbl_team("observer", "tripod", *join, "--for", 12).stdout)
        report = json.loads(team.communicate(timeout=60)[0])
    assert visited["lost"] == ""
    assert sum(flow["messages"] for flow in visited["sent"]) > 10
    guest = report["guests"]["tripod"]
    assert guest["messages_sent"] > 10
    assert guest["samples"] > 10
    counts = [robot["counts"].get("guest_joined", 0) for robot in report["robots"].values()]
    assert sum(counts) > 0


def test_a_printed_configuration_is_as_strict(team_file: Path) -> None:
    keys(team_file)
    endpoint = free_endpoint("tls")
    printed = cpcbl_team("router", team_file, "--listen", endpoint, "--print-config")
    assert "PRIVATE KEY" not in printed.stdout
    config = team_file.parent / "router.json5"
    config.write_text(printed.stdout)
    team = load_team(team_file)
    with running("router", "--config", config):
        with session(team, OPERATOR, endpoint) as listener, session(team, R1, endpoint) as robot:
            ear = Subscription(listener, "**")
            for key in ("status/r2", "status/r1"):
                publisher = robot.publisher(key, Qos.INPUT)
                wait_until(lambda publisher=publisher: publisher.matching)  # type: ignore[misc]
                publisher.put(b"?")
            wait_until(lambda: bool(ear.keys))
            assert ear.keys == ["status/r1"]
        with pytest.raises(BusError):
            with_credentials(team, None, endpoint.replace("tls/", "tcp/"))


def test_robots_of_a_router_of_its_own(team_file: Path) -> None:
    """`router`, `robot` and `traffic`, each with its own certificate."""
    keys(team_file)
    endpoint = free_endpoint("tls")
    team_file.write_text(
        TEAM.replace('source = "external"', 'source = "external"\nstart = {x_m = 0.0, y_m = 0.0}')
        + f'listen = ["{endpoint}"]\nconnect = ["{endpoint}"]\n'
    )
    with running("router", team_file), running("robot", "r1", "--team", team_file):
        with session(load_team(team_file), OPERATOR, endpoint) as operator:
            ear = Subscription(operator, topics.STATUS.at())
            assert eventually(lambda: bool(ear.samples))
        done = cpcbl_team("traffic", team_file, "--for", 4, "--wait", 30, "--json")
        assert list(json.loads(done.stdout)["robots"]) == ["r1"]


# Containers -------------------------------------------------------------------------------------


def services(file: Path) -> dict[str, Any]:
    """What `compose` says of each service of a team."""
    done = cpcbl_team("compose", file)
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


# Nobody is believed who names another in the payload --------------------------------------------

LIES = (
    Status("r2", "1", 1, 0.1, 0.1, 3, "", {}, 0, 0, 0, 0),
    Track("r2", 1, 0.0, 0.0, 0.0, None, 3),
    Drive("r2", 1, 1.0, 0.0),
)


@pytest.mark.parametrize("lie", LIES, ids=lambda m: type(m).__name__)
def test_a_name_in_a_payload_is_that_of_its_key(lie: Status | Track | Drive) -> None:
    (topic,) = [t for t in topics.TOPICS if t.carries is type(lie)]
    assert decode(topic.at(robot="r2"), encode(lie)) == lie
    assert decode(topic.at(robot="r1"), encode(lie)) is Refusal.NOT_ITS_OWN
    assert decode("in/r2/odometry", encode(lie)) is Refusal.WRONG_TYPE
    assert decode("field/nothing", encode(lie)) is Refusal.WRONG_TYPE
    assert decode(topic.at(robot="r2"), b"") is Refusal.EMPTY


def test_operators_are_not_told_lies_about_others(tmp_path: Path) -> None:
    team = secured_team(tmp_path)
    endpoint = free_endpoint("tls")
    with router_of(team, endpoint), session(team, R1, endpoint) as robot:
        stop = threading.Event()

        def lie_and_not() -> None:
            said = [
                (robot.publisher(topics.STATUS.at(robot="r1"), Qos.TELEMETRY), name)
                for name in ("r1", "r2")
            ]
            while not stop.wait(0.05):
                for publisher, name in said:
                    publisher.put(encode(Status(name, "1", 1, 0.1, 0.1, 3, "", {}, 0, 0, 0, 0)))

        speaking = threading.Thread(target=lie_and_not)
        speaking.start()
        try:
            seen = cpcbl_team(
                *("traffic", _written(team, tmp_path), "--connect", endpoint),
                *("--for", 2, "--json"),
            )
        finally:
            stop.set()
            speaking.join()
    assert list(json.loads(seen.stdout)["robots"]) == ["r1"]


def _written(team: Team, folder: Path) -> Path:
    from cpcbl_launch.team_file import save_resolved

    path = folder / "team.json"
    save_resolved(team, path)
    return path
