"""What `doctor` finds, from facts; and what is heard of teams on a bus."""

from datetime import UTC, datetime, timedelta
from io import StringIO

import pytest
from msgspec.structs import replace
from rich.console import Console
from support.buses import MS, SECOND, robot_at, team_of

from cpcbl_launch.views.doctor_checks import Finding, findings, is_well
from cpcbl_launch.views.doctor_facts import CertificateFile, EndpointFacts, Facts
from cpcbl_launch.views.listening import Sample, heard_by_team, listen
from cpcbl_launch.views.robot_status import robot_statuses, team_view
from cpcbl_team.config import Team, TransportSettings
from cpcbl_team.inputs import Odometry
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status, encode
from cpcbl_transport.topics import Qos

NOW = datetime(2026, 5, 1, tzinfo=UTC)
NOW_NS = 1_777_593_600 * SECOND
TEAM = team_of(r1=robot_at(), r2=robot_at())
ENDPOINT = "tcp/10.0.0.1:7447"
SECONDS = 2.0


def status_of(robot: str, incarnation: str = "1", stamp_ns: int = NOW_NS, lost: str = "") -> Status:
    return Status(robot, incarnation, stamp_ns, 0.01, 0.02, 1, lost, {}, 0, 0, 0, 0)


def status_samples(team: str, status: Status, count: int = 2) -> list[Sample]:
    key = f"cpcbl/{team}/{topics.STATUS.at(robot=status.robot)}"
    return [Sample(key, encode(status), NOW_NS)] * count


def odometry_samples(team: str, robot: str, stamp_ns: int = NOW_NS) -> list[Sample]:
    key = f"cpcbl/{team}/{topics.IN_ODOMETRY.at(robot=robot)}"
    return [Sample(key, encode(Odometry(stamp_ns - 100 * MS, stamp_ns, 0.0, 0.0)), NOW_NS)] * 20


def token(team: str, robot: str, incarnation: str = "1") -> str:
    return f"cpcbl/{team}/{topics.ALIVE.at(tier=1, robot=robot, incarnation=incarnation)}"


HEALTHY = [
    sample
    for robot in TEAM.robots
    for sample in (*status_samples("tests", status_of(robot)), *odometry_samples("tests", robot))
]
TOKENS = [token("tests", robot) for robot in TEAM.robots]


def facts_of(
    samples: list[Sample] = HEALTHY,
    tokens: list[str] = TOKENS,
    team: Team | None = TEAM,
    **more: object,
) -> Facts:
    """Facts of a team on a router where this is heard."""
    whole: dict[str, object] = {
        "now": NOW,
        "python": "3.12.0",
        "packages": {"cpcbl-team": "0.1.0"},
        "extras": {"camera": True},
        "file": "team.toml",
        "team": team,
        "endpoints": (EndpointFacts(endpoint=ENDPOINT, answer="open"),),
        "heard": heard_by_team(samples, tokens, SECONDS),
        "seconds": SECONDS,
    }
    return Facts(**{**whole, **more})  # type: ignore[arg-type]


def bad(facts: Facts) -> list[Finding]:
    """What is to be mended."""
    return [f for f in findings(facts) if f.level in ("warning", "error")]


def the_one(facts: Facts) -> tuple[str, str, str]:
    """(check, text, remedy) of the only thing that is to be mended."""
    (finding,) = bad(facts)
    assert not is_well([finding])
    return finding.check, finding.text, finding.remedy


def without(text: str) -> list[Sample]:
    return [sample for sample in HEALTHY if text not in sample.key]


def test_of_a_healthy_team_nothing_is_to_be_mended() -> None:
    found = findings(facts_of())
    assert is_well(found)
    assert any(finding.text == "in/r1/odometry: 10.0 Hz" for finding in found)


@pytest.mark.parametrize(
    ("answer", "text", "remedy"),
    [
        ("refused", "nothing listens at this port", "cpcbl-team router team.toml"),
        ("unknown host", "no machine has this name", "write its address"),
        ("silent", "a firewall", "ping"),
        ("open", "another version of Zenoh", "what uses the port"),
    ],
)
def test_without_a_router_its_remedy_depends_on_what_answers(
    answer: str, text: str, remedy: str
) -> None:
    endpoints = (EndpointFacts(endpoint=ENDPOINT, answer=answer),)
    check, said, how = the_one(facts_of([], endpoints=endpoints, router_problem="timeout"))
    assert check == "router"
    assert ENDPOINT in said
    assert text in said
    assert remedy in how


def test_a_robot_that_is_not_heard_is_to_be_started() -> None:
    check, text, remedy = the_one(facts_of(without("status/r2"), TOKENS[:1]))
    assert check == "robots"
    assert text == "r2: sends no status for 2 s"
    assert "cpcbl-team robot team.toml r2" in remedy
    check, text, remedy = the_one(facts_of(without("status/r2")))
    assert text.endswith("though its process is alive")


def test_a_name_that_is_used_twice_is_found_by_tokens_and_by_statuses() -> None:
    for facts in (
        facts_of(tokens=[*TOKENS, token("tests", "r1", "2")]),
        facts_of([*HEALTHY, *status_samples("tests", status_of("r1", "2"))]),
    ):
        assert the_one(facts)[1] == "r1: 2 processes have this name"
    replaced = [*status_samples("tests", status_of("r1", "0"), count=1), *HEALTHY]
    assert is_well(findings(facts_of(replaced)))  # it was started again meanwhile


@pytest.mark.parametrize(
    ("ahead_s", "text"),
    [
        (2.0, "2.0 s ahead of this"),
        (-3.0, "3.0 s behind this"),
        (0.05, ""),
        (-1e6, "12 days behind"),
    ],
)
def test_a_clock_that_is_off_is_found(ahead_s: float, text: str) -> None:
    off = status_samples("tests", status_of("r1", stamp_ns=NOW_NS + int(ahead_s * 1e9)))
    own = odometry_samples("tests", "r1", NOW_NS + int(ahead_s * 1e9))  # by the same clock
    rest = [sample for sample in HEALTHY if "r1" not in sample.key]
    found = bad(facts_of([*rest, *off, *own]))
    assert [(f.check, text in f.text, "NTP" in f.remedy) for f in found] == (
        [("clocks", True, True)] if text else []
    )


def test_the_time_of_a_simulation_is_no_clock() -> None:
    simulated = replace(robot_at(), source="simulated")
    team = replace(TEAM, robots={"r1": simulated, "r2": robot_at()})
    fast = status_samples("tests", status_of("r1", stamp_ns=NOW_NS + 30 * SECOND))
    samples = [*without("status/r1"), *fast]
    assert is_well(findings(facts_of(samples, team=team)))
    assert robot_statuses(heard_by_team(samples, TOKENS, SECONDS)["tests"], team)[0].problems == ()


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (NOW_NS + 2 * SECOND, "stamps are 2.0 s ahead of its robot's clock"),
        (NOW_NS - 5 * SECOND, "stamps are 5.0 s behind its robot's clock"),
        (NOW_NS // MS, "stamps are 1.78e+09 s away from its robot's clock"),
    ],
)
def test_stamps_of_another_clock_are_found(stamp_ns: int, text: str) -> None:
    samples = [*without("in/r1"), *odometry_samples("tests", "r1", stamp_ns)]
    check, said, _ = the_one(facts_of(samples))
    assert (check, said) == ("inputs", f"in/r1/odometry: {text}")


def test_a_driver_of_another_team_or_name_is_named() -> None:
    strayed = [*without("in/r1"), *odometry_samples("testz", "r1")]
    missing, foreign = bad(facts_of(strayed))
    assert missing.text == "nobody publishes to in/r1/odometry"
    assert foreign.text == "this team is `tests`; somebody publishes to `testz` (r1)"
    misspelt = [*without("in/r1"), *odometry_samples("tests", "r11")]
    unknown, missing = bad(facts_of(misspelt))
    assert unknown.text == "somebody publishes to in/r11/odometry"
    assert "no r11; r1?" in unknown.remedy
    elsewhere = [*without("status/r1"), *status_samples("testz", status_of("r1"))]
    missing, foreign = bad(facts_of(elsewhere, TOKENS[1:]))
    assert missing.text == "r1: sends no status for 2 s"
    assert foreign.text == "this team is `tests`; r1 is in `testz`"
    other = [*HEALTHY, *status_samples("other", status_of("r1"))]
    assert is_well(findings(facts_of(other)))  # two teams may share a router


def test_payloads_that_cannot_be_used_are_found() -> None:
    garbage = Sample("cpcbl/tests/in/r1/odometry", b"hello", NOW_NS)
    found = bad(facts_of([*HEALTHY, garbage]))
    assert [f.text for f in found] == ["in/r1/odometry: 1 messages cannot be used: wrong_version"]
    old = Sample("cpcbl/tests/status/r1", b"\x01", NOW_NS)
    assert the_one(facts_of([*HEALTHY, old]))[1] == "1 statuses cannot be used: wrong_version"


def test_what_strangers_write_cannot_write_to_the_terminal() -> None:
    evil = Sample("cpcbl/tests/in/\x1b[2J/odometry", b"x", NOW_NS)
    assert is_well(findings(facts_of([*HEALTHY, evil], [*TOKENS, token("te\x1bsts", "r1")])))
    lost = status_samples("tests", status_of("r1", lost="\x1b[2J" + "y" * 5000))
    (finding,) = bad(facts_of([*without("status/r1"), *lost]))
    assert finding.text.isprintable()
    assert len(finding.text) <= 600


def test_a_lost_robot_is_found() -> None:
    lost = status_samples("tests", status_of("r1", lost="innovations"))
    assert the_one(facts_of([*without("status/r1"), *lost]))[0] == "health"


@pytest.mark.parametrize(
    ("days", "level"), [(-1, "error"), (10, "warning"), (100, "good"), (None, "warning")]
)
def test_the_ends_of_certificates_are_found(days: int | None, level: str) -> None:
    until = None if days is None else NOW + timedelta(days=days)
    own = CertificateFile(who="robot/r1", file="keys/robot/r1/x.crt", valid_until=until)
    (finding,) = [f for f in findings(facts_of(certificates=(own,))) if f.check == "certificates"]
    assert finding.level == level
    assert ("--renew r1" in finding.remedy) is (days in (-1, 10))


def test_what_is_wrong_before_anything_runs_is_found() -> None:
    assert the_one(facts_of(link_problem="no key"))[:2] == ("certificates", "no key")
    ports = TransportSettings(listen=("tcp/0.0.0.0:7448",), connect=(ENDPOINT,))
    assert the_one(facts_of(team=replace(TEAM, transport=ports)))[0] == "ports"
    broken = facts_of([], team=None, file_problems=("team.toml: x", "team.toml: y"))
    assert [f.text for f in bad(broken)] == ["team.toml: x", "team.toml: y"]
    cameras = replace(TEAM, robots={"r1": replace(robot_at(), sensing="camera")})
    assert "extra camera" in bad(facts_of(team=cameras, extras={"camera": False}))[0].text


def test_listening_hears_all_teams_or_its_own() -> None:
    hub = MemoryHub()
    driver, stops = hub.session(), iter([False, True])

    def publish(key: str) -> bool:
        stop = next(stops)
        if not stop:
            driver.declare_token(f"{key}{topics.ALIVE.at(tier=1, robot='r1', incarnation=1)}")
            for topic in (topics.STATUS, topics.IN_ODOMETRY):
                payload = encode(status_of("r1")) if topic is topics.STATUS else b"?"
                driver.publisher(key + topic.at(robot="r1"), Qos.INPUT).put(payload)
        return stop

    heard = listen(hub.session(), 5.0, lambda: publish("cpcbl/laba/"))
    assert heard.keys() == {"laba"}
    assert heard["laba"].robots == ["r1"]
    assert heard["laba"].inputs[0].refused == {"wrong_version": 1}
    stops = iter([False, True])
    assert listen(hub.session(), 5.0, lambda: publish(""), "labb").keys() == {"labb"}


def test_the_fastest_status_tells_of_the_clock() -> None:
    late = [s._replace(arrival_ns=NOW_NS + 3 * SECOND) for s in HEALTHY if "status" in s.key]
    assert is_well(findings(facts_of([*HEALTHY, *late])))


def test_the_status_of_a_robot_tells_of_its_clock() -> None:
    off = status_samples("tests", status_of("r1", stamp_ns=NOW_NS + 2 * SECOND))
    heard = heard_by_team([*without("status/r1"), *off], TOKENS, SECONDS)["tests"]
    r1, r2 = robot_statuses(heard, TEAM)
    assert r1.problems == ("its clock is 2.0 s ahead of this machine's",)
    assert r2.problems == ()


def test_the_status_of_a_robot_has_its_problems() -> None:
    tokens = [*TOKENS, token("tests", "r1", "2"), token("tests", "r3")]
    heard = heard_by_team(without("status/r2"), tokens, SECONDS)["tests"]
    r1, r2, r3 = robot_statuses(heard, TEAM)
    assert r1.problems == ("2 processes have this name",)
    assert (r1.processes, r1.tier, r1.inputs[0].published_hz) == (2, 1, 10.0)
    assert r2.problems == r3.problems == ("waiting: its process runs, but has sent nothing yet",)
    assert r2.status_offset_s is None


def test_the_table_of_robots_has_the_words_of_the_view() -> None:
    heard = heard_by_team(without("status/r2"), TOKENS, SECONDS)["tests"]
    r1, r2 = robot_statuses(heard, TEAM)
    bad = [replace(r1, robot="r3", state="problem"), replace(r1, robot="r4", state="lost")]
    bad.append(replace(r1, robot="r5", state="unconfirmed", unconfirmed="it stood"))
    console = Console(width=80, record=True, file=StringIO())
    console.print(team_view([r1, r2, *bad]))
    rows = [line.split() for line in console.export_text().splitlines()]
    states = {row[0]: row[-1] for row in rows if row and row[0] in ("r1", "r2", "r3", "r4", "r5")}
    due = {"r1": "ok", "r2": "waiting", "r3": "problem", "r4": "lost", "r5": "unconfirmed"}
    assert states == due
    assert ["r5:", "it", "stood"] in rows
