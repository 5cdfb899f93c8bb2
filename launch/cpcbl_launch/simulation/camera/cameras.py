"""The cameras of a simulated team. Needs OpenCV; without a camera this module is not loaded."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from msgspec.structs import replace

from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_launch.simulation.camera.render import render
from cpcbl_launch.simulation.camera.scene import Scene, SceneRobot
from cpcbl_team.config import CameraSettings, Team
from cpcbl_team.geometry import Pose2
from cpcbl_transport.messages import LARGEST_FRAME, Frame

QUALITIES = (90, 75, 50, 25, 10)  # of a JPEG; the best that the guards let through
HEAD_BYTES = 64  # of a message, beside its picture
_SEED = 2**30  # apart from robots' own noise

cv2.setNumThreads(1)


class Cameras:
    """Takes pictures of the field. The same seed and the same calls give the same pictures.

    The errors of the cameras have the sigmas of their settings times the simulation's noise.
    """

    def __init__(self, team: Team, seed: int) -> None:
        self._scene = Scene.of(team)
        self._bare = self._scene.without_landmarks()
        names = enumerate(team.cameras)
        self._random = {name: np.random.default_rng((seed, _SEED, i)) for i, name in names}
        light, self._noise = team.simulation.light, team.simulation.noise
        self._light = replace(light, noise=light.noise * self._noise)
        self._cameras = {
            name: with_focal_error(team.robots[name].camera, self._noise, random)
            for name, random in self._random.items()
        }
        for i, name in enumerate(self._cameras):
            random = np.random.default_rng((seed, _SEED, i, 1))
            self._cameras[name] = with_yaw_error(self._cameras[name], self._noise, random)
            self._cameras[name] = with_centre_error(self._cameras[name], self._noise, random)
        guards = team.transport.guards
        allowed = guards.largest_frame_bytes if guards.enabled else LARGEST_FRAME
        self._largest = min(allowed, LARGEST_FRAME) - HEAD_BYTES

    def frame(self, viewer: str, stamp_ns: int, poses: Mapping[str, Pose2], bare: bool) -> Frame:
        """What a robot's camera sees now, from among all that stand on the field; `bare`: no
        landmark can be seen."""
        others = [SceneRobot(name, *pose) for name, pose in poses.items() if name != viewer]
        scene, random = self._bare if bare else self._scene, self._random[viewer]
        camera = Camera(with_mount_error(self._cameras[viewer], self._noise, random))
        pixels = render(scene, camera, poses[viewer], others, self._light, random)
        return Frame(stamp_ns, encode_jpeg_within(pixels, self._largest))


def with_focal_error(
    camera: CameraSettings, noise: float, random: np.random.Generator
) -> CameraSettings:
    """The settings with a random error of the focal length; its sigma is scaled by `noise`."""
    share = 1.0 + noise * camera.focal_share * float(random.normal())
    return replace(camera, fx_px=camera.fx_px * share, fy_px=camera.fy_px * share)


def with_yaw_error(
    camera: CameraSettings, noise: float, random: np.random.Generator
) -> CameraSettings:
    """The settings with a random error of the yaw that stays; its sigma is scaled by `noise`."""
    yaw = noise * camera.yaw_sigma_deg * float(random.normal())
    return replace(camera, yaw_deg=camera.yaw_deg + yaw, yaw_sigma_deg=0.0)


def with_centre_error(
    camera: CameraSettings, noise: float, random: np.random.Generator
) -> CameraSettings:
    """The settings with a random error of the principal point that stays; its sigma is scaled by
    `noise`."""
    share = noise * camera.centre_share * float(random.normal())
    return replace(camera, cx_px=camera.cx_px + camera.fx_px * share)


def with_mount_error(
    camera: CameraSettings, noise: float, random: np.random.Generator
) -> CameraSettings:
    """The settings with random errors of tilt, yaw and roll, as on an uneven floor; their sigmas
    are scaled by `noise`."""
    tilt, yaw, roll = (noise * float(draw) for draw in random.normal(size=3))
    return replace(
        camera,
        tilt_deg=camera.tilt_deg + camera.tilt_sigma_deg * tilt,
        yaw_deg=camera.yaw_deg + camera.yaw_sigma_deg * yaw,
        roll_deg=camera.roll_deg + camera.roll_sigma_deg * roll,
    )


def encode_jpeg_within(pixels: Pixels, largest: int, qualities: Sequence[int] = QUALITIES) -> bytes:
    """A picture as a JPEG of at most this size (bytes), if any of the qualities allows it."""
    image = b""
    for quality in qualities:
        _, buffer = cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, quality))
        image = buffer.tobytes()
        if len(image) <= largest:
            break
    return image
