"""`cpcbl-team calibrate ...`: errors of robots' odometry, sensors and cameras."""

from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.console import Console
from typer import Argument, Option, Typer, echo
from typer.core import TyperGroup

from cpcbl_launch.commands import options
from cpcbl_launch.commands.measuring import calibrate
from cpcbl_launch.commands.options import AsJson, print_not_written, print_result
from cpcbl_launch.reporting.files import write_or_reason
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.requirements import require_opencv, require_scipy
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.calibration.camera_accuracy import CameraDataset
    from cpcbl_launch.calibration.team_tables import Tables
    from cpcbl_launch.mapping.mapper import Mapped

LOG = "log"


class LogByDefault(TyperGroup):
    """A group whose usual command, `log`, need not be named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [LOG, *args]
        return super().parse_args(ctx, args)


calibrate_app = Typer(
    cls=LogByDefault,
    no_args_is_help=True,
    help="Errors of odometry, sensors and cameras, and places of landmarks, as tables of a team"
    " file. `calibrate [TEAM] LOG` is short for `calibrate log [TEAM] LOG`.",
)
calibrate_app.command(LOG)(calibrate)

INTO = " TEAM: the file to write into; without it the result is printed."
ToFile = Annotated[Path | None, Option(help="Write the team here; default: into TEAM.")]
Residuals = Annotated[
    Path | None,
    Option(
        help="Draw residuals into this file (PNG or SVG; extra `plot`).",
        callback=options.writable_picture,
    ),
]
BoardPictures = Annotated[
    list[Path] | None,
    Argument(
        metavar="[TEAM] PICTURE",
        help=f"Pictures of the board, folders of them, or videos.{INTO}",
    ),
]
BoardOption = Annotated[Literal["charuco", "chessboard"], Option(help="Kind of the printed board.")]
PrintBoard = Annotated[
    Path | None, Option(help="Write the board into this file (PNG), to be printed at 300 dpi.")
]
ColourPictures = Annotated[
    list[Path] | None,
    Argument(
        metavar="[TEAM] PICTURE",
        help=f"Pictures, or folders of them, with samples or without any colour.{INTO}",
    ),
]
Samples = Annotated[
    list[str] | None,
    Option(help="PICTURE:COLOUR=X,Y,WIDTH,HEIGHT, or X,Y,RADIUS; any number of them."),
]
SampleFile = Annotated[
    Path | None, Option(help="File of samples (TOML, JSON, CSV): picture, colour, at.")
]
Margin = Annotated[float, Option(min=0.0, max=0.9, help="Share by which ranges are widened.")]
Preview = Annotated[
    Path | None,
    Option(
        help="Draw samples, and accepted pixels, into this file (PNG, JPG).",
        callback=options.writable_file,
    ),
]
Recordings = Annotated[
    list[Path] | None,
    Argument(
        metavar="[TEAM] RECORDING",
        help=f"Recorded runs with truth (`up --record`) of robots with cameras.{INTO}",
    ),
]
PoseFolder = Annotated[Path | None, Option(help="Or a folder of pictures that a robot took.")]
Poses = Annotated[
    Path | None, Option(help="CSV of its poses: file, x_m, y_m, heading_deg; robot for teammates.")
]
Observer = Annotated[
    str | None, Option(help="Robot whose camera it is; default: all with a camera.")
]
IntoType = Annotated[str | None, Option("--type", help="Write into this type, not into the robot.")]
MapRuns = Annotated[
    list[Path],
    Argument(
        metavar="[TEAM] RUN",
        help=f"Recorded runs (folders, .mcap) or MRCLAM folders, of any days.{INTO}",
    ),
]
Known = Annotated[
    str,
    Option(
        help="Landmarks and walls whose places in TEAM (or the log) are used, with their sigmas,"
        " e.g. 6,20, or none. Default: all."
    ),
]
Withhold = Annotated[
    str, Option(help="Landmarks and walls that are estimated as if they were not known.")
]
StartOf = Annotated[
    str, Option("--start", help="Robot whose start in TEAM fixes the frame, without known places.")
]
PlaceSigma = Annotated[
    float, Option(min=0.0, help="How far a landmark seems to be from its measured place: σ.")
]
PathFolder = Annotated[
    Path | None,
    Option(callback=options.folder, help="Folder to write the robots' paths into (TUM files)."),
]
DryRun = Annotated[bool, Option("--dry-run", help="Print what would be written into TEAM.")]


@calibrate_app.command("camera")
def camera(
    words: BoardPictures = None,
    board: BoardOption = "charuco",
    squares: Annotated[str, Option(help="Across and down, black and white.")] = "7x5",
    square_m: Annotated[float, Option(min=0.001, help="Side of a square of the board.")] = 0.03,
    marker_m: Annotated[float, Option(help="Side of a marker (charuco).")] = 0.022,
    family: Annotated[str, Option(help="Family of the markers (charuco).")] = "aruco_4x4_50",
    every: Annotated[float, Option(min=0.0, help="Seconds between two frames of a video.")] = 0.5,
    print_board: PrintBoard = None,
    robot: Annotated[str | None, Option(help="Write into this robot's table.")] = None,
    kind: Annotated[str | None, Option("--type", help="Or into this robot type's table.")] = None,
    output: ToFile = None,
    picture: Residuals = None,
    as_json: AsJson = False,
) -> None:
    """Lens and distortion of a camera, from pictures of a printed board."""
    require_opencv("calibrate camera")
    from cpcbl_launch.calibration.lens import calibrate_lens, parse_board, write_board
    from cpcbl_launch.calibration.pictures import picture_files, read_pictures
    from cpcbl_launch.calibration.reports import print_lens
    from cpcbl_launch.calibration.team_tables import camera_table, robot_table
    from cpcbl_launch.views.run import progress_bar

    team_file, pictures = options.team_and_files(words or ())
    printed = parse_board(board, squares, square_m, marker_m, family)
    if print_board is not None:
        options.require_writable_file("--print-board", print_board)
        write_board(printed, print_board)
        measure = "measure a square of it when it is printed"
        echo(f"written: {print_board}; {measure}", err=as_json)
        if not pictures:
            return
    if not pictures:
        raise InputError("calibrate camera: name pictures of the board, or --print-board FILE.png")
    _check_target(team_file, output)
    table = robot_table(team_file, robot, kind, "camera")
    files = picture_files(pictures)
    with progress_bar("finding the board", quiet=as_json) as progress:
        lens, residuals = calibrate_lens(read_pictures(files, every, progress), printed)
    lost: dict[str, str] = {}
    if picture is not None:
        from cpcbl_launch.calibration.plots import draw_lens_residuals

        lost |= write_or_reason(picture, partial(draw_lens_residuals, lens, residuals, picture))
    print_result(lens, as_json, lambda: print_lens(lens, Console()))
    print_not_written(lost | _save({table: camera_table(lens)}, team_file, output, as_json))


@calibrate_app.command("colours")
def colours(
    words: ColourPictures = None,
    sample: Samples = None,
    samples: SampleFile = None,
    margin: Margin = 0.4,
    preview: Preview = None,
    output: ToFile = None,
    as_json: AsJson = False,
) -> None:
    """Thresholds of colours, from samples of them in pictures."""
    require_opencv("calibrate colours")
    from cpcbl_launch.calibration import colour_samples
    from cpcbl_launch.calibration.colours import calibrate_colours
    from cpcbl_launch.calibration.pictures import picture_files
    from cpcbl_launch.calibration.reports import print_colours
    from cpcbl_launch.calibration.team_tables import colour_tables, unsampled_colours

    team_file, pictures = options.team_and_files(words or ())
    chosen = [colour_samples.parse_sample(text) for text in sample or ()]
    chosen += colour_samples.read_samples(samples) if samples is not None else []
    if not chosen:
        raise InputError("calibrate colours: name areas of colours by --sample or --samples")
    if preview is not None:
        colour_samples.require_picture_name(preview)
    _check_target(team_file, output)
    files = picture_files(pictures)
    labelled = colour_samples.label_pictures(colour_samples.resolve_pictures(chosen, files), files)
    kept, file_has_kept = unsampled_colours(team_file, {s.colour for s in chosen})
    patches = colour_samples.colour_patches(labelled)
    result = calibrate_colours(patches, colour_samples.unlabelled_pixels(labelled), kept, margin)
    lost: dict[str, str] = {}
    if preview is not None:
        every = {name: fit.thresholds for name, fit in result.colours.items()} | result.kept
        pixels = colour_samples.draw_preview(labelled, every)
        lost |= write_or_reason(preview, partial(colour_samples.write_preview, preview, pixels))
    print_result(result, as_json, lambda: print_colours(result, Console()))
    tables = colour_tables(result, file_has_kept)
    print_not_written(lost | _save(tables, team_file, output, as_json))


@calibrate_app.command("sensor")
def sensor(
    words: Recordings = None,
    pictures: PoseFolder = None,
    poses: Poses = None,
    robot: Observer = None,
    kind: IntoType = None,
    output: ToFile = None,
    as_json: AsJson = False,
) -> None:
    """Range and bearing noise of cameras against known poses, and whether their σ are right."""
    from cpcbl_launch.calibration.camera_accuracy import (
        dataset_from_recordings,
        measure_camera_accuracy,
    )
    from cpcbl_launch.calibration.reports import print_camera_accuracy
    from cpcbl_launch.calibration.team_tables import robot_table, sensor_tables
    from cpcbl_launch.recordings.merge import recording_files

    team_file, recordings = options.team_and_files(words or ())
    if bool(recordings) == (pictures is not None):
        raise InputError("calibrate sensor: name recordings, or --pictures FOLDER --poses FILE.csv")
    _check_target(team_file, output)
    if pictures is None:
        with recording_files(recordings) as files:
            dataset = dataset_from_recordings(files, robot)
    else:
        dataset = _dataset_from_pictures(pictures, poses, team_file, robot, as_json)
    is_robots_own = team_file is not None and not kind and len(dataset.robots) == 1
    owner = dataset.robots[0] if is_robots_own else None
    paths = [robot_table(team_file, owner, kind, part) for part in ("sensor", "camera")]
    accuracy = measure_camera_accuracy(dataset.observations)
    print_result(accuracy, as_json, lambda: print_camera_accuracy(accuracy, dataset, Console()))
    tables = sensor_tables(accuracy, dataset.camera, *paths)
    print_not_written(_save(tables, team_file, output, as_json))


@calibrate_app.command("map")
def landmark_map(
    words: MapRuns,
    known: Known = "",
    withhold: Withhold = "",
    start: StartOf = "",
    place_sigma_m: PlaceSigma = 0.006,
    output: ToFile = None,
    dry_run: DryRun = False,
    picture: options.PictureFile = None,
    export: PathFolder = None,
    as_json: AsJson = False,
) -> None:
    """Places of landmarks and walls, and paths, from runs of one or more robots and days."""
    require_scipy("calibrate map")
    from cpcbl_launch.mapping.command import map_runs
    from cpcbl_launch.mapping.report import map_report, map_tables, print_map
    from cpcbl_launch.recordings.merge import recording_files
    from cpcbl_launch.run.logged_team import builtin_for, file_for
    from cpcbl_launch.views.run import progress_bar

    team_file, runs = options.team_and_files(words)
    if not runs:
        raise InputError("calibrate map: name recorded runs, or MRCLAM folders, after the team")
    if not dry_run:
        _check_target(team_file, output)
    names = [run.resolve().name for run in runs]
    wanted = options.parse_names(known), options.parse_names(withhold), start, place_sigma_m
    with recording_files(runs) as files, progress_bar("mapping", quiet=as_json) as progress:
        is_recorded = files[0].suffix == ".mcap"
        team_path = None if is_recorded else builtin_for(files[0])
        if team_file is not None:
            team_path = team_file if is_recorded else file_for(team_file, files[0])
        begin_s = perf_counter()
        team = None if team_path is None else find_team(team_path)
        mapped = map_runs(team, files, names, *wanted, progress)
    result = map_report(mapped, names, perf_counter() - begin_s)
    print_result(result, as_json, lambda: print_map(result, Console()))
    lost = _write_map_files(mapped, picture, export)
    target = None if dry_run else team_file
    print_not_written(lost | _save(map_tables(result), target, output, as_json))


def _write_map_files(mapped: "Mapped", picture: Path | None, export: Path | None) -> dict[str, str]:
    """Writes what `--picture` and `--export` ask for; files not written, with the reason."""
    from cpcbl_launch.mapping.command import export_paths

    lost: dict[str, str] = {}
    if picture is not None:
        from cpcbl_launch.mapping.plots import draw_map

        lost |= write_or_reason(picture, partial(draw_map, mapped, picture))
    if export is not None:
        lost |= write_or_reason(export, partial(export_paths, mapped, export))
    return lost


def _dataset_from_pictures(
    pictures: Path, poses: Path | None, team_file: Path | None, robot: str | None, quiet: bool
) -> "CameraDataset":
    """Sightings of a robot of the team file in pictures. Raises InputError."""
    from cpcbl_launch.calibration.camera_accuracy import dataset_from_pictures
    from cpcbl_launch.views.run import progress_bar

    require_opencv("calibrate sensor --pictures")
    if poses is None:
        raise InputError("--pictures: needs --poses FILE.csv, the poses of the camera")
    if team_file is None:
        raise InputError(
            "--pictures: name the team file, which has landmarks and robots, as the first argument"
        )
    team = find_team(team_file)
    with progress_bar("detecting", quiet) as progress:
        return dataset_from_pictures(pictures, poses, robot, team, progress)


def _check_target(team_file: Path | None, output: Path | None) -> None:
    """Raises InputError, TeamFileError before anything is measured in vain."""
    from cpcbl_launch.calibration.team_tables import team_source

    if team_file is not None:
        option, target = "--output" if output else "TEAM", team_source(team_file, output)[1]
        options.require_writable_file(option, target)
    elif output is not None:
        raise InputError("--output: name the team file to write as the first argument")


def _save(
    tables: "Tables", team_file: Path | None, output: Path | None, quiet: bool
) -> dict[str, str]:
    """Writes the tables into the team file or prints them; files not written, with the reason."""
    from cpcbl_launch.calibration import team_tables

    if team_file is None:
        if not quiet:
            echo(f"\n{team_tables.tables_text(tables)}", nl=False)
        return {}
    text, target = team_tables.team_source(team_file, output)
    changed = team_tables.edit_team(text, str(team_file), tables)
    lost = write_or_reason(target, lambda: team_tables.replace_file(target, changed))
    for table, values in tables.items() if not quiet else ():
        for own in team_tables.overridden_keys(changed, table, list(values)):
            echo(f"{own} stays, and overrides {table}")
    if not lost and not quiet:
        echo(f"written: {target}")
    return lost
