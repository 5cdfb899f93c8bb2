"""A robot's camera, and what it looks for: coloured cylinders and markers."""

from typing import Annotated, Literal

import msgspec

from cpcbl_team.config.table import NotNegative, Positive, Table

Side = Literal["front", "left", "back", "right"]
MarkerFamily = Literal[
    "aruco_4x4_50",
    "aruco_5x5_50",
    "aruco_6x6_50",
    "apriltag_16h5",
    "apriltag_25h9",
    "apriltag_36h11",
    "apriltag_standard41h12",
]
MARKERS: dict[MarkerFamily, int] = {
    "aruco_4x4_50": 50,
    "aruco_5x5_50": 50,
    "aruco_6x6_50": 50,
    "apriltag_16h5": 30,
    "apriltag_25h9": 35,
    "apriltag_36h11": 587,
    "apriltag_standard41h12": 2115,
}
"""The number of markers in a family: 0, 1, ..."""
LIKE_MIRRORED: dict[MarkerFamily, frozenset[int]] = {
    "aruco_4x4_50": frozenset({8, 9, 17, 47}),
    "apriltag_standard41h12": frozenset({1597}),
}
"""Markers that equal their own mirror image, so that a marker seen in a mirror looks like them."""


class CameraSettings(Table, frozen=True, kw_only=True):
    """A camera and its mounting, `robot_from_camera`.

    The camera is a pinhole with OpenCV's distortion. The robot's frame is x forward, y left, z up,
    from the floor below its centre. Yaw is to the left, tilt is down, roll is clockwise as the
    camera sees it.
    """

    frames: str = ""
    """A device's number, a URL (RTSP, HTTP), a video file or a folder of images, relative to the
    team file; empty: images come as messages on `in/<robot>/frame`."""
    width_px: Annotated[int, msgspec.Meta(ge=16, le=8192)] = 640
    height_px: Annotated[int, msgspec.Meta(ge=16, le=8192)] = 480
    fx_px: Positive = 400.0
    fy_px: Positive = 400.0
    cx_px: float = 319.5
    cy_px: float = 239.5
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's k1, k2, p1, p2, k3."""
    x_m: float = 0.0
    y_m: float = 0.0
    mounted_m: Positive = 0.2
    """The height of the lens above the floor."""
    yaw_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    edge_sigma_px: Positive = 0.4
    """The accuracy with which the edge of a band, or the corner of a marker, is found."""
    tilt_sigma_deg: NotNegative = 1.0
    """The accuracy of the tilt, because no mount is exact, floors are not even and robots nod; it
    limits ranges from foot points."""
    roll_sigma_deg: NotNegative = 1.0
    """The accuracy of the roll, for the same reasons."""
    yaw_sigma_deg: NotNegative = 2.0
    """The accuracy of the yaw: an error that all bearings have in common."""
    focal_share: NotNegative = 0.025
    """The accuracy of the focal length as a share: an error that all ranges have in common."""
    centre_share: NotNegative = 0.025
    """The accuracy of the principal point `cx_px`, as a share of the focal length: an error that
    all bearings have in common, more in the middle of the image than at its edges."""

    self_calibration: bool = True
    """Whether the robot corrects its yaw, its focal length and its principal point while it drives,
    where landmarks and odometry show that they are wrong."""

    @property
    def live(self) -> bool:
        """Whether images come from a device or a URL, and not from files or messages."""
        where = self.frames
        return where.isdecimal() or "://" in where or where.startswith("/dev/")


class Colour(Table, frozen=True, kw_only=True):
    """Lower and upper limits of one colour in OpenCV's 8-bit HSV, both included."""

    hue: tuple[int, int]
    """0 to 179, in half degrees; a lower limit above the upper one spans red."""
    saturation: tuple[int, int] = (80, 255)
    value: tuple[int, int] = (40, 255)


COLOURS = {
    "red": Colour(hue=(172, 8)),
    "orange": Colour(hue=(10, 20)),
    "yellow": Colour(hue=(23, 35)),
    "green": Colour(hue=(50, 75)),
    "cyan": Colour(hue=(83, 98)),
    "blue": Colour(hue=(105, 122)),
    "pink": Colour(hue=(145, 168)),
}


class Cylinder(Table, frozen=True, kw_only=True):
    """The shape of a coloured landmark or mast: two bands of the same height, one on the other."""

    radius_m: Positive = 0.05
    height_m: Positive = 0.4
    """The height of both bands together."""
    foot_m: NotNegative = 0.0
    """The height of the lower band's lower edge above the floor."""


class VisionSettings(Table, frozen=True, kw_only=True):
    """What the team's cameras look for."""

    colours: dict[str, Colour] = msgspec.field(default_factory=COLOURS.copy)
    """The colours that a file names replace all built-in ones."""
    landmark: Cylinder = Cylinder()
    """The shape of coloured landmarks."""
    mast: Cylinder = Cylinder(radius_m=0.04, height_m=0.16, foot_m=0.25)
    """The shape of robots' colour bands, above their centre."""
    family: MarkerFamily = "aruco_4x4_50"
    marker_m: Positive = 0.12
    """The side of a marker's black square; of the white one in the black one of
    `apriltag_standard41h12`, which is 5/9 of the whole marker."""
    marker_mounted_m: Positive = 0.12
    """The height of a marker's centre above the floor; markers stand upright."""
    marker_distance_m: Positive = 0.12
    """The distance from the robot's centre to each of its markers."""
