"""A calibrated lens as a person sees it, and as a team file has it."""

from rich.console import Console

from cpcbl_launch.calibration.lens import DISTORTION, Lens
from cpcbl_launch.calibration.statistics import decimals
from cpcbl_launch.calibration.team_edit import Written, written
from cpcbl_launch.reporting.tables import number, percent, table


def print_lens(lens: Lens, console: Console) -> None:
    """The pictures, then the lens; fits 80 columns."""
    pictures = table("pictures", ("picture",), ("corners", "error px"))
    pictures.add_column("left out", overflow="fold")
    for view in lens.pictures:
        corners = str(view.corners) if view.corners else "-"
        pictures.add_row(view.picture, corners, number(view.rms_px), view.left_out)
    console.print(pictures)
    console.print()
    used = sum(not view.left_out for view in lens.pictures)
    title = f"{lens.width_px} x {lens.height_px}, {used} pictures, {lens.rms_px:.3f} px RMS"
    shown = table(title, ("lens",), ("value", "± standard deviation"))
    for name, known in (lens.intrinsics | lens.distortion).items():
        if known.standard_error == 0.0:
            continue
        digits = decimals(known.standard_error)
        shown.add_row(name, f"{known.value:.{digits}f}", f"{known.standard_error:.{digits}f}")
    shown.add_section()
    shown.add_row("focal_share", f"{lens.focal_share:.4f}", "")
    shown.add_row("covered", percent(lens.covered), "")
    console.print(shown)
    for note in lens.notes:
        console.print(note, style="yellow", highlight=False)


def camera_values(lens: Lens) -> dict[str, Written]:
    """The keys of a team file's table `camera` that pictures of a board tell."""
    distortion = [written(lens.distortion[name]) for name in DISTORTION]
    size = {"width_px": Written(lens.width_px), "height_px": Written(lens.height_px)}
    return {
        **size,
        **{name: written(known) for name, known in lens.intrinsics.items()},
        "distortion": Written(
            [item.value for item in distortion],
            ", ".join(item.remark or "not told" for item in distortion),
        ),
        "focal_share": Written(round(lens.focal_share, 4)),
    }
