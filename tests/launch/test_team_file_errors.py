"""Each mistake in a team file is one line that names the file, the key and the fix."""

from pathlib import Path
from typing import NamedTuple

import pytest
from support.team_texts import ROBOT, robots

from cpcbl_launch.team.file import TeamFileError, load_team


class Wrong(NamedTuple):
    """A text with one mistake; the one line about it begins with the key and has the fix."""

    what: str
    text: str
    key: str
    fix: str


WRONG = [
    # unknown keys, at each level
    Wrong("unknown table", "[robot.r1]", "robot", "did you mean 'robots'?"),
    Wrong(
        "unknown key without a like", "zzz = 1", "zzz", "known here: calibrated_on, data, defaults"
    ),
    Wrong("unknown in defaults", "[defaults]\nspeed = 1.0", "defaults.speed", "'speed_m_s'"),
    Wrong(
        "unknown in a table of defaults",
        "[defaults.sensor]\nrange_shar = 1.0",
        "defaults.sensor.range_shar",
        "'range_share'",
    ),
    Wrong("unknown in a type", "[types.a]\nsenso = {}", "types.a.senso", "'sensor'"),
    Wrong(
        "unknown three deep",
        "[types.a.localizer.weights]\npositon = 0.1",
        "types.a.localizer.weights.positon",
        "'position'",
    ),
    Wrong("unknown in a robot", "[robots.r2]\nstrat = {}", "robots.r2.strat", "'start'"),
    Wrong(
        "unknown in a start",
        "[robots.r2.start]\nx_m = 0.0\ny_m = 0.0\nheading = 1.0",
        "robots.r2.start.heading",
        "'heading_deg'",
    ),
    Wrong("unknown in the map", "[map]\nlandmark = {}", "map.landmark", "'landmarks'"),
    Wrong(
        "unknown in a landmark",
        "[map.landmarks.oak]\nx_m = 1.0\ny_m = 1.0\ngive = 'both'",
        "map.landmarks.oak.give",
        "'gives'",
    ),
    Wrong(
        "unknown in a wall",
        "[map.walls.north]\nfrom_m = [0.0, 0.0]\nto = [1.0, 0.0]",
        "map.walls.north.to",
        "'to_m'",
    ),
    Wrong("unknown in transport", "[transport]\nlisten_at = []", "transport.listen_at", "listen"),
    Wrong(
        "unknown in a colour",
        "[vision.colours.orange]\nhues = [1, 2]",
        "vision.colours.orange.hues",
        "'hue'",
    ),
    Wrong(
        "unknown in an event",
        "[[simulation.events]]\nat = 1.0",
        "simulation.events[0].at",
        "'at_s'",
    ),
    Wrong("unknown in simulation", "[simulation]\nnois = 1", "simulation.nois", "'noise'"),
    # types and ranges
    Wrong("text for a number", "[simulation]\nnoise = 'x'", "simulation.noise", "a number"),
    Wrong("number for a table", "[defaults]\nsensor = 3", "defaults.sensor", "a table"),
    Wrong("number for a robot", "robots.r2 = 3", "robots.r2", "write [robots.r2]"),
    Wrong("list for a robot", "[[robots.r2]]", "robots.r2", "write [robots.r2]"),
    Wrong("number for a name", "name = 3", "name", "a text"),
    Wrong("text for a list", "[transport]\nlisten = 'x'", "transport.listen", "a list"),
    Wrong(
        "three numbers for a point",
        "[defaults]\nwaypoints_m = [[1.0, 2.0, 3.0]]",
        "defaults.waypoints_m",
        "length 2",
    ),
    Wrong(
        "text in a landmark",
        "[map.landmarks.oak]\nx_m = 'west'\ny_m = 1.0",
        "map.landmarks.oak.x_m",
        "a number",
    ),
    Wrong("below the range", "[simulation]\nnoise = -1.0", "simulation.noise", ">= 0.0"),
    Wrong(
        "zero for a positive number",
        "[defaults.sensor]\nrate_hz = 0",
        "defaults.sensor.rate_hz",
        "> 0.0",
    ),
    Wrong(
        "above the range",
        "[types.a.sensor]\nfield_of_view_deg = 361.0",
        "types.a.sensor.field_of_view_deg",
        "<= 360.0",
    ),
    Wrong(
        "no such choice",
        "[defaults.localizer]\nvariant = 'jont'",
        "defaults.localizer.variant",
        "'jont'",
    ),
    Wrong("NaN", "[simulation]\nnoise = nan", "simulation.noise", "finite"),
    Wrong("infinite", "[defaults]\nwaypoints_m = [[0.0, inf]]", "defaults.waypoints_m", "finite"),
    Wrong("too many digits", f"[simulation]\nnoise = 1{'0' * 400}", "simulation.noise", "range"),
    # what is missing
    Wrong("a start without y_m", "[robots.r2.start]\nx_m = 1.0", "robots.r2.start.y_m", "missing"),
    Wrong(
        "a landmark without y_m",
        "[map.landmarks.oak]\nx_m = 1.0",
        "map.landmarks.oak.y_m",
        "missing",
    ),
    Wrong("a simulated robot without a start", "[robots.r2]", "robots.r2.start", "add x_m"),
    Wrong("no endpoint to connect to", "[transport]\nconnect = []", "transport.connect", "tcp/"),
    # types of robots
    Wrong(
        "an unknown type",
        "[types.a]\n[robots.r2]\ntype = 'b'",
        "robots.r2.type",
        "a type that has its table [types.NAME], here: a",
    ),
    Wrong("a number for a type", "[robots.r2]\ntype = 3", "robots.r2.type", "3"),
    Wrong("a list for a type", "[robots.r2]\ntype = ['a']", "robots.r2.type", "'a'"),
    # names
    Wrong("a robot's name with a space", '[robots."r 2"]', "robots", "r 2"),
    Wrong("a type's name with a space", '[types."a b"]', "types", "a b"),
    Wrong("a team's name with a space", 'name = "my team"', "name", "A-Za-z0-9"),
    Wrong(
        "a landmark's name with a space",
        '[map.landmarks."an oak"]\nx_m = 1.0\ny_m = 1.0',
        "map",
        "an oak",
    ),
    Wrong(
        "a wall's name that is too long",
        f"[map.walls.{'w' * 33}]\nfrom_m = [0.0, 0.0]\nto_m = [1.0, 0.0]",
        "map",
        "w" * 33,
    ),
    Wrong(
        "a landmark named like a robot", "[map.landmarks.r1]\nx_m = 1.0\ny_m = 1.0", "map", "'r1'"
    ),
    Wrong(
        "a landmark named like a wall",
        "[map.landmarks.n]\nx_m = 1.0\ny_m = 1.0\n"
        "[map.walls.n]\nfrom_m = [0.0, 0.0]\nto_m = [1.0, 0.0]",
        "map",
        "'n' names two things; rename",
    ),
    # what does not go together
    Wrong(
        "a wall without a length",
        "[map.walls.n]\nfrom_m = [1.0, 1.0]\nto_m = [1.0, 1.0]",
        "map.walls.n",
        "move to_m",
    ),
    Wrong(
        "an endpoint without a protocol",
        "[transport]\nlisten = ['127.0.0.1:7447']",
        "transport.listen",
        "tcp/192.168.1.10:7447",
    ),
    Wrong(
        "an endpoint without a port",
        "[transport]\nconnect = ['tcp/127.0.0.1']",
        "transport.connect",
        "tcp/192.168.1.10:7447",
    ),
    Wrong(
        "a guard that drops every second frame of a fast camera",
        "[transport.guards]\nfix_rate_hz = 90.0\n[defaults.sensor]\nrate_hz = 60.0",
        "transport.guards.fix_rate_hz",
        "robots.r1 has 60 Hz; raise it to 120 or more",
    ),
    Wrong(
        "a guard below the rate of beliefs",
        "[transport.guards]\nbelief_rate_hz = 5.0",
        "transport.guards.belief_rate_hz",
        "raise it to 10 or more",
    ),
    Wrong(
        "a guard that lets nothing in",
        "[transport.guards]\nlargest_help_bytes = 0",
        "transport.guards.largest_help_bytes",
        ">= 1",
    ),
    Wrong(
        "joint with the paper's uncertainty",
        "[defaults.localizer]\npaper_uncertainty = true",
        "robots.r1.localizer.paper_uncertainty",
        "circular or oval",
    ),
    Wrong(
        "oval that updates both at once",
        "[defaults.localizer]\nvariant = 'oval'\nalternate = false",
        "robots.r1.localizer.alternate",
        "remove",
    ),
    Wrong(
        "a marker that the family lacks",
        "[defaults.markers]\nfront = 50",
        "robots.r1.markers.front",
        "use 0 to 49",
    ),
    Wrong(
        "a marker that another family has",
        "[vision]\nfamily = 'apriltag_16h5'\n[defaults.markers]\nleft = 30",
        "robots.r1.markers.left",
        "use 0 to 29",
    ),
    Wrong(
        "a marker below none", "[defaults.markers]\nback = -1", "robots.r1.markers.back", "use 0 to"
    ),
    Wrong("a side that robots lack", "[defaults.markers]\ntop = 1", "defaults.markers", "'top'"),
    Wrong(
        "a marker on two sides",
        "[defaults.markers]\nfront = 3\nback = 3",
        "robots.r1.markers.back",
        "give each side its own",
    ),
    Wrong(
        "a marker that is its own mirror image",
        "[defaults.markers]\nfront = 17",
        "robots.r1.markers.front",
        "use another",
    ),
]


def complaint(path: Path, text: str) -> str:
    """The one line about a file, without the file's name."""
    path.write_text(text, encoding="utf-8")
    with pytest.raises(TeamFileError) as caught:
        load_team(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    return said.removeprefix(f"{path}: ")


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.what)
def test_a_mistake_is_one_line_with_key_and_fix(tmp_path: Path, wrong: Wrong) -> None:
    name = "" if wrong.text.startswith("name") else 'name = "t"\n'
    top_level = not wrong.text.startswith("[")
    parts = [name, wrong.text, ROBOT] if top_level else [name, ROBOT, wrong.text]
    said = complaint(tmp_path / "team.toml", "\n".join(parts))
    assert said[: len(wrong.key)] == wrong.key
    assert wrong.fix in said.removeprefix(wrong.key)


def test_two_robots_may_carry_the_same_marker() -> None:
    other = ROBOT.replace("r1", "r2")
    both = robots(f"{ROBOT}markers = {{ front = 3 }}\n{other}markers = {{ left = 3 }}")
    assert both["r1"].markers == {"front": 3}
    assert both["r2"].markers == {"left": 3}


def test_every_text_with_a_mistake_has_only_that_one() -> None:
    assert list(robots(ROBOT)) == ["r1"]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (ROBOT, "name: missing"),
        ('name = "t"', "robots: missing"),
        ('name = "t"\n[robots]', "robots: there is none; add a table [robots.r1]"),
        ('name = "t"\n[robots', "not TOML: "),
        ('name = "t"\nname = "u"', "not TOML: "),
    ],
    ids=["no name", "no robots", "empty robots", "not TOML", "a key twice"],
)
def test_a_file_that_is_no_team_is_one_line(tmp_path: Path, text: str, names: str) -> None:
    assert complaint(tmp_path / "team.toml", text).startswith(names)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    path = tmp_path / "nothing.toml"
    with pytest.raises(TeamFileError, match=f"^{path}: no such file$"):
        load_team(path)


@pytest.mark.parametrize("suffix", ["toml", "json"])
def test_what_cannot_be_read_is_named(tmp_path: Path, suffix: str) -> None:
    binary, folder = tmp_path / f"binary.{suffix}", tmp_path / f"folder.{suffix}"
    binary.write_bytes(b"\xff\xfe\x00")
    folder.mkdir()
    for path in (binary, folder):
        with pytest.raises(TeamFileError, match=f"^{path}: cannot be read: "):
            load_team(path)
