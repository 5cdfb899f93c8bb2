"""`cpcbl-team calibrate ...`: how robots' odometry, sensors and cameras err."""

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer
from typer.core import TyperGroup

from cpcbl_launch.commands.arguments import AsJson, print_not_written
from cpcbl_launch.commands.measuring import calibrate
from cpcbl_launch.team_file import find_team
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.calibration.sights import Looked
    from cpcbl_launch.calibration.team_edit import Place, Written

LOG = "log"


class BoardName(StrEnum):
    charuco = "charuco"
    chessboard = "chessboard"


class OfLogs(TyperGroup):
    """A group whose usual command, `log`, need not be named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [LOG, *args]
        return super().parse_args(ctx, args)


calibrate_app = typer.Typer(
    cls=OfLogs,
    no_args_is_help=True,
    help="How odometry, sensors and cameras err, as tables of a team file. `calibrate LOG` is short"
    " for `calibrate log LOG`.",
)
calibrate_app.command(LOG)(calibrate)

ToTeam = Annotated[
    Optional[Path], typer.Option("--team", help="Team file to write into; default: print.")
]
OfRobot = Annotated[Optional[str], typer.Option(help="Into this robot's table, or")]
OfType = Annotated[Optional[str], typer.Option("--type", help="into this robot type's.")]
ToFile = Annotated[
    Optional[Path], typer.Option(help="Write the team here; default: into the --team file.")
]
Residuals = Annotated[
    Optional[Path], typer.Option(help="Draw residuals into this file (PNG or SVG; extra `plot`).")
]


@calibrate_app.command("camera")
def camera(
    pictures: Annotated[
        Optional[list[Path]],
        typer.Argument(help="Pictures of the board, folders of them, or videos."),
    ] = None,
    board: Annotated[BoardName, typer.Option(help="What is printed.")] = BoardName.charuco,
    squares: Annotated[str, typer.Option(help="Across and down, black and white.")] = "7x5",
    square_m: Annotated[float, typer.Option(min=0.001, help="Side of a square.")] = 0.03,
    marker_m: Annotated[float, typer.Option(help="Side of a marker (charuco).")] = 0.022,
    family: Annotated[str, typer.Option(help="Of the markers (charuco).")] = "aruco_4x4_50",
    every: Annotated[
        float, typer.Option(min=0.0, help="Of a video a frame every so many seconds.")
    ] = 0.5,
    print_board: Annotated[
        Optional[Path],
        typer.Option(help="Write the board into this file (PNG), to be printed at 300 dpi."),
    ] = None,
    team_file: ToTeam = None,
    robot: OfRobot = None,
    kind: OfType = None,
    output: ToFile = None,
    picture: Residuals = None,
    as_json: AsJson = False,
) -> None:
    """Lens and distortion of a camera, from pictures of a printed board."""
    from rich.console import Console

    from cpcbl_launch.checks import require_matplotlib, require_opencv
    from cpcbl_launch.commands.options import require_writable_file
    from cpcbl_launch.reporting.files import json_text, write_or_reason
    from cpcbl_launch.views.run import progress_bar

    require_opencv("calibrate camera")
    from cpcbl_launch.calibration.board import parsed_board, write_board
    from cpcbl_launch.calibration.lens import calibrated_lens
    from cpcbl_launch.calibration.lens_show import camera_values, print_lens
    from cpcbl_launch.calibration.pictures import picture_files, read_pictures
    from cpcbl_launch.calibration.team_edit import robot_place

    printed = parsed_board(board, squares, square_m, marker_m, family)
    if print_board is not None:
        require_writable_file("--print-board", print_board)
        write_board(printed, print_board)
        typer.echo(
            f"written: {print_board}; measure a square of it when it is printed", err=as_json
        )
        if not pictures:
            return
    if not pictures:
        raise InputError("calibrate camera: name pictures of the board, or --print-board FILE.png")
    if picture is not None:
        require_writable_file("--picture", picture)
        require_matplotlib("--picture", picture)
    _check_target(team_file, output)
    place = robot_place(team_file, robot, kind, "camera")
    files = picture_files(pictures)
    with progress_bar("finding the board", quiet=as_json) as progress:
        seen = read_pictures(files, every, progress)
        lens, left = calibrated_lens(seen, printed)
    lost: dict[str, str] = {}
    if (drawing := picture) is not None:
        from cpcbl_launch.calibration.lens_picture import draw_lens

        lost |= write_or_reason(drawing, lambda: draw_lens(lens, left, drawing))
    if as_json:
        typer.echo(json_text(lens))
    else:
        print_lens(lens, Console())
    lost |= _save({place: camera_values(lens)}, team_file, output, as_json)
    print_not_written(lost)


@calibrate_app.command("colours")
def colours(
    pictures: Annotated[
        Optional[list[Path]],
        typer.Argument(help="Pictures, or folders of them: where samples are, or no colour is."),
    ] = None,
    sample: Annotated[
        Optional[list[str]],
        typer.Option(help="PICTURE:COLOUR=X,Y,WIDTH,HEIGHT, or X,Y,RADIUS; any number of them."),
    ] = None,
    samples: Annotated[
        Optional[Path],
        typer.Option(help="File of samples (TOML, JSON, CSV): picture, colour, at."),
    ] = None,
    margin: Annotated[
        float, typer.Option(min=0.0, max=0.9, help="Share by which ranges are widened.")
    ] = 0.4,
    preview: Annotated[
        Optional[Path],
        typer.Option(help="Draw samples, and what the thresholds take, into this file (PNG, JPG)."),
    ] = None,
    team_file: ToTeam = None,
    output: ToFile = None,
    as_json: AsJson = False,
) -> None:
    """Thresholds of colours, from samples of them in pictures."""
    from rich.console import Console

    from cpcbl_launch.checks import require_opencv
    from cpcbl_launch.commands.options import require_writable_file
    from cpcbl_launch.reporting.files import json_text, write_or_reason

    require_opencv("calibrate colours")
    from cpcbl_launch.calibration import patches
    from cpcbl_launch.calibration.colours import calibrated_colours
    from cpcbl_launch.calibration.colours_show import colour_values, kept_colours, print_colours
    from cpcbl_launch.calibration.pictures import picture_files
    from cpcbl_launch.calibration.samples import named_in, parsed_sample, read_samples

    said = [parsed_sample(text) for text in sample or ()]
    said += read_samples(samples) if samples is not None else []
    if not said:
        raise InputError("calibrate colours: say where colours are, by --sample or --samples")
    if preview is not None:
        require_writable_file("--preview", preview)
        patches.must_write(preview)
    _check_target(team_file, output)
    files = picture_files(pictures or [])
    seen = patches.labelled(named_in(said, files), files)
    kept, stays = kept_colours(team_file, {s.colour for s in said})
    found = calibrated_colours(patches.patches_of(seen), patches.elsewhere(seen), kept, margin)
    lost: dict[str, str] = {}
    if (drawing := preview) is not None:
        every = {name: fit.thresholds for name, fit in found.colours.items()} | found.kept
        shown = patches.preview(seen, every)
        lost |= write_or_reason(drawing, lambda: patches.write_preview(drawing, shown))
    if as_json:
        typer.echo(json_text(found))
    else:
        print_colours(found, Console())
    lost |= _save(colour_values(found, stays), team_file, output, as_json)
    print_not_written(lost)


@calibrate_app.command("sensor")
def sensor(
    recordings: Annotated[
        Optional[list[Path]],
        typer.Argument(help="Recordings with truth (`up --record`, .mcap) of robots with cameras."),
    ] = None,
    pictures: Annotated[
        Optional[Path], typer.Option(help="Or a folder of pictures that a robot took.")
    ] = None,
    poses: Annotated[
        Optional[Path],
        typer.Option(help="Where (CSV): file, x_m, y_m, heading_deg, and robot for teammates."),
    ] = None,
    team_file: ToTeam = None,
    robot: Annotated[
        Optional[str], typer.Option(help="Whose eyes; default: all with a camera.")
    ] = None,
    kind: Annotated[
        Optional[str], typer.Option("--type", help="Write into this type, not into the robot.")
    ] = None,
    output: ToFile = None,
    as_json: AsJson = False,
) -> None:
    """Range and bearing noise of cameras against known poses, and whether they know it."""
    from rich.console import Console

    from cpcbl_launch.calibration.agreement import calibrated_seeing
    from cpcbl_launch.calibration.seeing_show import print_seeing, seeing_values
    from cpcbl_launch.calibration.sights import recorded
    from cpcbl_launch.calibration.team_edit import robot_place
    from cpcbl_launch.reporting.files import json_text

    if bool(recordings) == (pictures is not None):
        raise InputError("calibrate sensor: name recordings, or --pictures FOLDER --poses FILE.csv")
    _check_target(team_file, output)
    if pictures is None:
        looked = recorded(recordings or [], robot)
    else:
        looked = _photographed(pictures, poses, team_file, robot, as_json)
    one = looked.robots[0] if len(looked.robots) == 1 else None
    sensor, camera = (
        robot_place(team_file, None if kind or team_file is None else one, kind, part)
        for part in ("sensor", "camera")
    )
    seeing = calibrated_seeing(looked.sights)
    if as_json:
        typer.echo(json_text(seeing))
    else:
        print_seeing(seeing, looked, Console())
    values = seeing_values(seeing, looked.camera, sensor, camera)
    print_not_written(_save(values, team_file, output, as_json))


def _photographed(
    pictures: Path, poses: Path | None, team_file: Path | None, robot: str | None, quiet: bool
) -> "Looked":
    """What a robot of the team file sees in pictures. Raises InputError."""
    from cpcbl_launch.calibration.sights import photographed, viewer
    from cpcbl_launch.checks import require_opencv
    from cpcbl_launch.views.run import progress_bar

    require_opencv("calibrate sensor --pictures")
    if poses is None:
        raise InputError("--pictures: goes with --poses FILE.csv, where they were taken")
    if team_file is None:
        raise InputError("--pictures: goes with --team FILE, which says what is to be seen")
    team = find_team(team_file)
    whose = viewer(team, robot)
    with progress_bar("looking", quiet) as progress:
        return photographed(pictures, poses, whose, team, progress)


def _check_target(team_file: Path | None, output: Path | None) -> None:
    """Raises InputError, TeamFileError before anything is measured in vain."""
    from cpcbl_launch.calibration.team_edit import team_source
    from cpcbl_launch.commands.options import require_writable_file

    if team_file is not None:
        require_writable_file("--output" if output else "--team", team_source(team_file, output)[1])
    elif output is not None:
        raise InputError("--output: goes with --team FILE, the team to write")


def _save(
    places: "Mapping[Place, Mapping[str, Written]]",
    team_file: Path | None,
    output: Path | None,
    quiet: bool,
) -> dict[str, str]:
    """Into the team file, or printed; what could not be written, with the reason."""
    from cpcbl_launch.calibration.team_edit import (
        as_toml,
        edited,
        replace_file,
        shadowed,
        team_source,
    )
    from cpcbl_launch.reporting.files import write_or_reason

    if team_file is None:
        if not quiet:
            typer.echo(f"\n{as_toml(places)}", nl=False)
        return {}
    text, target = team_source(team_file, output)
    changed = edited(text, str(team_file), places)
    lost = write_or_reason(target, lambda: replace_file(target, changed))
    for place, values in places.items() if not quiet else ():
        for own in shadowed(changed, place, list(values)):
            typer.echo(f"{own} stays, and goes before {place}")
    if not lost and not quiet:
        typer.echo(f"written: {target}")
    return lost
