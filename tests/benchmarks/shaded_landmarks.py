"""Landmarks of the team `eyes` in shadow and in poor light (`landmark_frames.py`), and natural
pictures without any: what its detector names, what it ranges, and how far that is off."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from benchmarks.degraded_frames import Pixels, natural_frame
from benchmarks.landmark_frames import LIGHTS, LightKind, Lit, landmark_frame
from msgspec.structs import replace
from rich.table import Table

from cpcbl_agents.vision.detections import Detections
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Team
from cpcbl_team.inputs import Sighting

VIEWERS = ("rover1", "spotter")  # in turn: 0.2 m high, and 0.5 m high with a wider lens
CALIBRATED = {"yaw_sigma_deg": 0.1, "focal_share": 0.005, "centre_share": 0.005}


class LandmarkScore(NamedTuple):
    """What the frames of one kind of light came to. `ranges` and `bearings`: rows of
    (error, stated sigma), in shares of the range and in rad."""

    kind: str
    frames: int
    named: int
    wrong: int
    ranges: list[tuple[float, float]]
    bearings: list[tuple[float, float]]

    @property
    def ranged(self) -> float:
        return len(self.ranges) / self.frames


def eyes() -> Team:
    """The shipped team, with cameras that are calibrated."""
    team = load_team(builtin_path("eyes"))
    robots = {
        name: replace(robot, camera=replace(robot.camera, **CALIBRATED))
        for name, robot in team.robots.items()
    }
    return replace(team, robots=robots)


def shaded_landmarks(
    kind: LightKind, frames: int, backgrounds: Sequence[Pixels], seed: int = 1
) -> LandmarkScore:
    """The detectors of both viewers on frames of one kind."""
    return score_of(kind, shaded_frames(kind, frames, backgrounds, seed))


def shaded_frames(
    kind: LightKind, frames: int, backgrounds: Sequence[Pixels], seed: int
) -> Iterator[tuple[str, Lit]]:
    """Frames of one kind, for the viewers in turn, each with the name of its landmark."""
    team, random = eyes(), np.random.default_rng([seed, LIGHTS.index(kind)])
    names, landmarks = sorted(team.map.landmarks), team.map.landmarks
    for number in range(frames):
        name = names[int(random.integers(len(names)))]
        upper, lower = (team.vision.colours[c] for c in landmarks[name].colours or ())
        settings, shape = team.robots[VIEWERS[number % 2]].camera, team.vision.landmark
        yield name, landmark_frame(kind, (upper, lower), backgrounds, random, settings, shape)


def score_of(kind: LightKind, frames: Iterable[tuple[str, Lit]]) -> LandmarkScore:
    """What the detectors of the viewers find in these frames."""
    detectors = [CameraDetector(name, eyes()) for name in VIEWERS]
    score = LandmarkScore(kind, 0, 0, 0, [], [])
    for number, (name, frame) in enumerate(frames):
        found = detectors[number % 2].detections(frame.pixels)
        seen = found.sightings if isinstance(found, Detections) else ()
        own = [one for one in seen if one.id == name]
        score = score._replace(
            frames=number + 1,
            named=score.named + len(own),
            wrong=score.wrong + len(seen) - len(own),
        )
        for one in own:
            _note(score, one, frame)
    return score


def _note(score: LandmarkScore, one: Sighting, frame: Lit) -> None:
    """Adds the errors of a sighting to a score."""
    if one.bearing_rad is not None and one.bearing_sigma_rad is not None:
        off = math.remainder(one.bearing_rad - frame.bearing_rad, math.tau)
        score.bearings.append((off, one.bearing_sigma_rad))
    if one.range_m is not None and one.range_sigma_m is not None:
        off, sigma = one.range_m - frame.range_m, one.range_sigma_m
        score.ranges.append((off / frame.range_m, sigma / frame.range_m))


def false_landmarks(backgrounds: Sequence[Pixels], frames: int, seed: int = 1) -> tuple[int, int]:
    """How many objects the detector of a rover names in parts of pictures that have none, and how
    many of them with a range."""
    detector, random = CameraDetector(VIEWERS[0], eyes()), np.random.default_rng(seed)
    named = ranged = 0
    for _ in range(frames):
        found = detector.detections(natural_frame(backgrounds, random, detector.camera.settings))
        if isinstance(found, Detections):
            named += len(found.sightings)
            ranged += sum(one.range_m is not None for one in found.sightings)
    return named, ranged


def printed(scores: Sequence[LandmarkScore]) -> Table:
    table = Table(title=f"{scores[0].frames} frames of a landmark in each light")
    table.add_column("light")
    quantities = [f"{q} {what}" for q in ("r", "b") for what in ("bias", "σ", "3σ", "max")]
    for heading in ("named", "ranged", "wrong", *quantities):
        table.add_column(heading, justify="right")
    for score in scores:
        row = [score.kind, f"{score.named / score.frames:.2f}", f"{score.ranged:.2f}"]
        row.append(str(score.wrong))
        for rows, unit, digits in ((score.ranges, 100.0, 2), (score.bearings, 180 / math.pi, 3)):
            errors, sigmas = np.array(rows or [(0.0, 1.0)]).T
            shares = np.abs(errors) / sigmas
            row += [f"{unit * errors.mean():+.{digits}f}", f"{unit * errors.std():.{digits}f}"]
            row += [f"{(shares < 3.0).mean():.3f}", f"{shares.max():.1f}"]
        table.add_row(*row)
    return table
