"""`calibrate colours` finds thresholds from samples, says what they are worth, writes them down."""

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.processes import command_line

from cpcbl_agents.vision.camera import Pixels
from cpcbl_launch.calibration.colour_samples import (
    ColourSample,
    colour_patches,
    draw_preview,
    label_pictures,
    parse_sample,
    read_samples,
    resolve_pictures,
    unlabelled_pixels,
)
from cpcbl_launch.calibration.colours import (
    ColourCalibration,
    ColourPatch,
    Hsv,
    calibrate_colours,
    colour_mask,
    thresholds,
)
from cpcbl_launch.calibration.team_tables import colour_tables, edit_team, unsampled_colours
from cpcbl_launch.team.file import TeamFileError, load_team, parse_team
from cpcbl_team.config import COLOURS, Colour
from cpcbl_team.errors import InputError

PAINT = {  # BGR in full light
    "red": (40, 30, 210),
    "orange": (20, 110, 240),
    "yellow": (30, 215, 235),
    "green": (70, 170, 40),
    "blue": (190, 90, 20),
    "pink": (170, 70, 230),
}
SIZE_PX = 40
TEAM = """name = "lab"
[map.landmarks]
door = { x_m = 0.0, y_m = 0.0, colours = ["red", "blue"] } # by the window
[robots.a]
source = "external"
colours = ["yellow", "green"]
"""


def painted(
    paint: Mapping[str, tuple[int, int, int]], light: float, seed: int, gradient: float = 0.35
) -> Pixels:
    """Squares side by side on grey, lit from the left, with noise: (80, n x 60, 3), BGR."""
    random = np.random.default_rng(seed)
    picture = np.full((2 * SIZE_PX, 60 * len(paint), 3), 120.0)
    for i, colour in enumerate(paint.values()):
        picture[20 : 20 + SIZE_PX, 60 * i + 10 : 60 * i + 10 + SIZE_PX] = colour
    shade = np.linspace(1.0, 1.0 - gradient, picture.shape[1])[None, :, None]
    noise = random.normal(0.0, 4.0, picture.shape)
    pixels: Pixels = np.clip(light * shade * picture + noise, 0, 255).astype(np.uint8)
    return pixels


def boxes(paint: Mapping[str, object], picture: Path) -> list[ColourSample]:
    """The squares, without their edges."""
    at = {name: (60 * i + 13, 23, SIZE_PX - 6, SIZE_PX - 6) for i, name in enumerate(paint)}
    return [ColourSample(picture, name, box) for name, box in at.items()]


def seen(pixels: Pixels) -> Hsv:
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2HSV).astype(np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("colours")
    for i, light in enumerate((1.0, 0.8, 0.6)):
        cv2.imwrite(str(path / f"{i}.png"), painted(PAINT, light, i))
    return path


def found_in(folder: Path, kept: Mapping[str, Colour] | None = None) -> ColourCalibration:
    files = sorted(folder.glob("?.png"))
    pictures = label_pictures([s for f in files for s in boxes(PAINT, f)], [])
    return calibrate_colours(colour_patches(pictures), unlabelled_pixels(pictures), kept)


def test_thresholds_take_their_colour_in_other_light_and_nothing_else(folder: Path) -> None:
    found = found_in(folder)
    assert found.overlaps == ()
    assert found.notes == ()
    for name, fit in found.colours.items():
        assert fit.taken[name] > 0.96
        assert fit.unseen is not None
        assert fit.unseen > 0.9
        assert max(share for other, share in fit.taken.items() if other != name) < 0.005
        assert fit.pixels == 3 * (SIZE_PX - 6) ** 2
        assert fit.elsewhere < 0.06  # the edges of the squares are not labelled
    anew = painted(PAINT, 0.62, seed=9)
    for i, (name, fit) in enumerate(found.colours.items()):
        square = seen(anew)[23:57, 60 * i + 13 : 60 * i + 47]
        assert colour_mask(square, fit.thresholds).mean() > 0.98, name
        wall = seen(anew)[:15]
        assert colour_mask(wall, fit.thresholds).mean() < 0.01


def test_hues_go_through_red(folder: Path) -> None:
    red = found_in(folder).colours["red"].thresholds
    assert red.hue[0] > 160
    assert red.hue[1] < 12
    middle = np.array([[179, 200, 200], [0, 200, 200], [90, 200, 200]], np.uint8)
    assert colour_mask(middle, red).tolist() == [True, True, False]


@pytest.mark.parametrize("hue", [0, 3, 60, 120, 177])
def test_a_range_of_hues_holds_its_samples_wherever_it_is(hue: int) -> None:
    random = np.random.default_rng(hue)
    hsv = np.full((2000, 3), 180, np.uint8)
    hsv[:, 0] = np.round(random.normal(hue, 2.0, 2000)) % 180
    colour = thresholds([ColourPatch("one", hsv)])["one"]
    assert colour_mask(hsv, colour).mean() > 0.99
    assert (colour.hue[1] - colour.hue[0]) % 180 == pytest.approx(
        16, abs=2
    )  # 4 sigma and 4 at each end


def test_ranges_are_widened_up_to_the_middle_between_neighbours() -> None:
    def patch(name: str, low: int, high: int) -> ColourPatch:
        hsv = np.full((600, 3), 200, np.uint8)
        hsv[:, 0] = np.random.default_rng(low).integers(low, high + 1, 600) % 180
        return ColourPatch(name, hsv)

    found = thresholds([patch("a", 175, 188), patch("b", 10, 24), patch("c", 80, 90)], 0.5)
    assert found["a"].hue[1] == 8  # the gap is of one hue
    assert found["b"].hue[0] == 10
    assert found["b"].hue[1] > 28
    assert found["c"].hue == (75, 95)


def test_colours_that_overlap_are_said_with_the_fix() -> None:
    paint = {"red": (40, 30, 210), "brick": (40, 35, 200), "blue": (190, 90, 20)}
    picture = painted(paint, 0.9, 1)
    patches = [
        ColourPatch(s.colour, seen(picture)[23:57, s.at[0] : s.at[0] + 34].reshape(-1, 3))
        for s in boxes(paint, Path())
    ]
    found = calibrate_colours(patches, seen(picture).reshape(-1, 3))
    (overlap,) = found.overlaps
    assert {overlap.one, overlap.other} == {"red", "brick"}
    assert any("overlap at hues" in n and "colours farther apart" in n for n in found.notes)
    assert found.colours["red"].taken["brick"] > 0.5
    assert any(note.startswith("blue: one sample") for note in found.notes)


def test_a_kept_colour_may_overlap_too(folder: Path) -> None:
    found = found_in(folder, {"crimson": COLOURS["red"]})
    assert ("red", "crimson") in [(o.one, o.other) for o in found.overlaps]


def test_grey_has_no_hue() -> None:
    random = np.random.default_rng(1)
    grey = np.clip(random.normal(120, 6, (40, 40, 3)), 0, 255).astype(np.uint8)
    colour = thresholds([ColourPatch("grey", seen(grey).reshape(-1, 3))])["grey"]
    assert colour.hue == (0, 179)
    assert colour_mask(seen(grey), colour).mean() > 0.95
    assert not colour_mask(np.array([60, 200, 120], np.uint8), colour)


def test_light_that_no_other_sample_has_is_said(tmp_path: Path) -> None:
    paint = {"green": PAINT["green"]}
    for i, light in enumerate((1.0, 0.25)):
        cv2.imwrite(str(tmp_path / f"{i}.png"), painted(paint, light, i, gradient=0.0))
    pictures = label_pictures([s for i in "01" for s in boxes(paint, tmp_path / f"{i}.png")], [])
    found = calibrate_colours(colour_patches(pictures), unlabelled_pixels(pictures))
    assert any("the light differs" in note for note in found.notes)


# Samples ------------------------------------------------------------------------------------------


def test_samples_are_read_from_options_and_files(tmp_path: Path) -> None:
    assert parse_sample("a:b.png:red=1,2,30,40") == ColourSample(
        Path("a:b.png"), "red", (1, 2, 30, 40)
    )
    assert parse_sample("a.png:red=1,2,5").at == (1, 2, 5)
    expected = [
        ColourSample(tmp_path / "a.png", "red", (1, 2, 30, 40)),
        ColourSample(tmp_path / "b.png", "blue", (7, 8, 5)),
    ]
    texts = {
        "s.toml": "[[samples]]\npicture = 'a.png'\ncolour = 'red'\nat = [1, 2, 30, 40]\n"
        "[[samples]]\npicture = 'b.png'\ncolour = 'blue'\nat = [7, 8, 5]\n",
        "s.json": '{"samples": [{"picture": "a.png", "colour": "red", "at": [1, 2, 30, 40]},'
        ' {"picture": "b.png", "colour": "blue", "at": [7, 8, 5]}]}',
        "s.csv": "picture,colour,x,y,width,height\na.png,red,1,2,30,40\n\nb.png, blue, 7, 8, 5,\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        assert read_samples(tmp_path / name) == expected
    assert resolve_pictures(expected, [Path("x/b.png")]) == expected
    loose = [ColourSample(Path("b.png"), "blue", (7, 8, 5))]
    assert resolve_pictures(loose, [Path("x/b.png")])[0].picture == Path("x/b.png")


@pytest.mark.parametrize("text", ["a.png", "a.png:red", "a.png:red=1,2", "red=1,2,3", "a:r=1,2,-3"])
def test_samples_that_are_none_are_said(text: str) -> None:
    with pytest.raises(InputError, match="write it as PICTURE:COLOUR=X,Y,WIDTH,HEIGHT"):
        parse_sample(text)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("s.csv", "a.png,red,1,2\n"),
        ("s.csv", "a.png,red,1,two,3\n"),
        ("s.json", '{"samples": [{"picture": "a.png", "at": [1, 2, 3]}]}'),
        ("s.toml", "samples = 3"),
        ("s.toml", "samples ="),
    ],
)
def test_files_that_hold_no_samples_are_said(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=r"--samples .*; each has picture, colour, at"):
        read_samples(tmp_path / name)


def test_samples_outside_of_their_picture_are_said(folder: Path) -> None:
    for at in ((350, 70, 20, 5), (400, 5, 3), (5, 5, 0, 9)):
        with pytest.raises(InputError, match="is not inside 360 x 80 px"):
            label_pictures([ColourSample(folder / "0.png", "red", at)], [])
    with pytest.raises(InputError, match=r"no\.png: No such file"):
        label_pictures([ColourSample(folder / "no.png", "red", (1, 1, 3))], [])
    with pytest.raises(InputError, match="red: fewer than 20 pixels"):
        calibrate_colours(
            [ColourPatch("red", np.zeros((19, 3), np.uint8))], np.zeros((0, 3), np.uint8)
        )


def test_a_point_with_a_radius_is_a_disc(folder: Path) -> None:
    (picture,) = label_pictures([ColourSample(folder / "0.png", "red", (30, 40, 10))], [])
    ((_, mask),) = picture.samples
    assert mask.sum() == pytest.approx(np.pi * 10.5**2, rel=0.1)
    assert len(unlabelled_pixels([picture])) == mask.size - mask.sum()


def test_the_preview_shows_what_is_taken_and_what_is_both(folder: Path) -> None:
    (picture,) = label_pictures(boxes(PAINT, folder / "0.png"), [])
    found = found_in(folder)
    colours = {name: fit.thresholds for name, fit in found.colours.items()}
    right = draw_preview([picture], colours)[:, 360:]
    for i, name in enumerate(colours):
        hue = int(seen(right)[40, 60 * i + 30, 0])
        assert colour_mask(np.array([hue, 255, 255], np.uint8), colours[name])
    both = draw_preview([picture], {**colours, "again": colours["blue"]})[:, 360:]
    assert both[40, 60 * 4 + 30].tolist() == [255, 255, 255]
    assert right[5, 5].max() < 60


# Writing ------------------------------------------------------------------------------------------


def test_a_file_gets_all_colours_that_it_uses(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(TEAM)
    kept, stays = unsampled_colours(path, {"red", "orange"})
    assert (sorted(kept), stays) == (["blue", "green", "yellow"], False)
    files = [folder / "0.png"]
    patches = [
        p
        for p in colour_patches(label_pictures([s for f in files for s in boxes(PAINT, f)], []))
        if p.colour in ("red", "orange")
    ]
    found = calibrate_colours(patches, np.zeros((0, 3), np.uint8), kept)
    text = edit_team(TEAM, "lab.toml", colour_tables(found, stays))
    assert "# by the window" in text
    colours = parse_team(text).vision.colours
    assert sorted(colours) == ["blue", "green", "orange", "red", "yellow"]
    assert colours["blue"] == COLOURS["blue"]
    assert colours["red"] == found.colours["red"].thresholds
    path.write_text(text + "\n[vision.colours.mud]\nhue = [1, 2] # seen once\n")
    kept, stays = unsampled_colours(path, {"red"})
    assert (sorted(kept), stays) == (["blue", "green", "mud", "orange", "yellow"], True)
    again = edit_team(path.read_text(), "lab.toml", colour_tables(found, stays))
    assert "# seen once" in again
    assert parse_team(again).vision.colours["mud"] == Colour(hue=(1, 2))


def test_a_colour_that_only_samples_know_may_be_used_by_the_file(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(TEAM.replace('"red"', '"brick"'))
    with pytest.raises(TeamFileError, match="no colour 'brick'"):
        load_team(path)
    kept, stays = unsampled_colours(path, {"brick"})
    hsv = np.tile(np.array([[10, 200, 150]], np.uint8), (50, 1))
    found = calibrate_colours([ColourPatch("brick", hsv)], hsv, kept)
    assert (
        "brick"
        in parse_team(edit_team(path.read_text(), "x", colour_tables(found, stays))).vision.colours
    )


def test_a_table_of_colours_in_one_line_stays_one() -> None:
    text = TEAM + "[vision]\ncolours.red = { hue = [170, 5] }\ncolours.blue.hue = [100, 120]\n"
    text += "[vision.colours.yellow]\nhue = [20, 30]\n[vision.colours.green]\nhue = [50, 60]\n"
    text = text.replace("colours.red = ", "[vision.colours]\nred = ").replace(
        "colours.blue", "blue"
    )
    text = text.replace("[vision]\n", "")
    hsv = np.tile(np.array([[1, 200, 150]], np.uint8), (50, 1))
    found = calibrate_colours([ColourPatch("red", hsv)], hsv)
    changed = edit_team(text, "x", colour_tables(found, True))
    assert parse_team(changed).vision.colours["red"] == found.colours["red"].thresholds
    assert "red = {" in changed


# Command line -------------------------------------------------------------------------------------


def test_the_command_line_writes_a_team_that_it_can_check(folder: Path, tmp_path: Path) -> None:
    team, drawing, file = tmp_path / "lab.toml", tmp_path / "seen.png", tmp_path / "s.csv"
    team.write_text(TEAM)
    rows = [s for i in range(3) for s in boxes(PAINT, folder / f"{i}.png")]
    file.write_text("".join(f"{s.picture},{s.colour},{','.join(map(str, s.at))}\n" for s in rows))
    ran = command_line(*("calibrate", "colours", team, "--samples", file, "--preview", drawing))
    assert ran.returncode == 0, ran.stderr
    assert max(len(line) for line in ran.stdout.splitlines()[:-1]) <= 80
    for word in ("thresholds, 8-bit HSV", "orange", "elsewhere", f"written: {team}"):
        assert word in ran.stdout
    assert cv2.imread(str(drawing)).shape == (3 * 80, 720, 3)  # type: ignore[union-attr]
    colours = load_team(team).vision.colours
    assert colours.keys() == PAINT.keys()
    assert "# by the window" in team.read_text()
    assert command_line("check", team).returncode == 0


def test_json_and_what_is_wrong_in_one_line(folder: Path, tmp_path: Path) -> None:
    samples = ["--sample", "0.png:red=13,23,34,34", "--sample", "1.png:red=30,40,15"]
    ran = command_line("calibrate", "colours", folder, *samples, "--json")
    assert ran.returncode == 0, ran.stderr
    red = json.loads(ran.stdout)["colours"]["red"]
    assert red["samples"] == 2
    assert red["taken"]["red"] > 0.95
    for arguments, said in (
        ([folder], "name areas of colours"),
        ([folder, "--sample", "red"], "write it as PICTURE:COLOUR="),
        ([folder, *samples, "--preview", tmp_path / "p.txt"], "p.txt: not a picture"),
        (["demo", folder, *samples], "a built-in team cannot be changed"),
        (["--sample", "no.png:red=1,2,3"], "no.png: No such file"),
    ):
        failed = command_line("calibrate", "colours", *arguments)
        assert failed.returncode == 2
        (line,) = failed.stderr.splitlines()
        assert said in line
