"""`make bench-degraded`: a robot's detector beside OpenCV's and pupil-apriltags, in one run, on
frames of a bad camera with natural pictures behind the markers (`degraded_frames.py`).

For each kind of degradation it prints how many of the markers were recalled, wrong ids, the share
of errors inside three stated sigmas and the worst of them, and the 99th percentile of the time of a
frame as a multiple of OpenCV's. The peers are in the extra `bench`; a family that one of them does
not have is compared with the other alone. `--photographs FOLDER` counts instead how many tags of
photographs each of them reads (`photographs.py`), and `--landmarks N` shows the detector landmarks
in shadow and in poor light (`shaded_landmarks.py`).
"""

import argparse
import math
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, get_args

import cv2
import msgspec
import numpy as np
from benchmarks.degraded_frames import (
    KINDS,
    SIDES,
    Degraded,
    Pixels,
    degraded_frame,
    marker_ratio,
    natural_frame,
)
from benchmarks.landmark_frames import LIGHTS
from benchmarks.photographs import tags_read
from benchmarks.readers import Reader, own_reader, peers
from benchmarks.shaded_landmarks import false_landmarks, shaded_landmarks
from benchmarks.shaded_landmarks import printed as printed_landmarks
from rich.console import Console
from rich.table import Table
from support.cameras import calibrated

from cpcbl_agents.vision.detections import Detections
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_team.config import MarkerFamily, RobotSettings, Team, VisionSettings
from cpcbl_team.inputs import Sighting

SUBJECT = "r0"
LEAST_PICTURE_PX = 240
MARKER_M = 0.12  # the whole marker
QUANTITIES = ("range", "bearing", "heading")


class Score(NamedTuple):
    """What one kind of frames came to. Errors (n,) in stated sigmas, by quantity."""

    kind: str
    frames: int
    recalled: int
    peers_recalled: tuple[int, ...]
    wrong: int
    peers_wrong: tuple[int, ...]
    errors: dict[str, list[float]]
    seconds: list[float]
    peers_seconds: tuple[list[float], ...]

    @property
    def recall(self) -> float:
        return self.recalled / self.frames

    @property
    def best_peer(self) -> float:
        return max(self.peers_recalled, default=0) / self.frames

    def inside(self, quantity: str) -> float:
        """The share of errors within three stated sigmas."""
        return float(np.mean(np.array(self.errors[quantity] or [0.0]) < 3.0))


def marked_team(family: MarkerFamily) -> Team:
    """A robot that looks, and robots with markers; the frames show the first of these."""
    numbers = iter(range(16))
    robots = {f"r{k}": RobotSettings(markers={s: next(numbers) for s in SIDES}) for k in range(4)}
    return Team(
        name="degraded",
        robots={"me": RobotSettings(), **robots},
        vision=VisionSettings(family=family, marker_m=MARKER_M / marker_ratio(family)),
    )


def measured(
    kind: str,
    frames: int,
    family: MarkerFamily,
    backgrounds: Sequence[Pixels],
    peers: Sequence[Reader] = (),
    seed: int = 1,
) -> Score:
    """The detector, and its peers, on frames of one kind."""
    team, settings = marked_team(family), calibrated()
    detector = CameraDetector("me", team)
    random = np.random.default_rng([seed, KINDS.index(kind)])
    errors: dict[str, list[float]] = {quantity: [] for quantity in QUANTITIES}
    seconds: list[list[float]] = [[] for _ in range(len(peers) + 1)]
    recalled, wrong = [0] * len(seconds), [0] * len(seconds)
    for _ in range(frames):
        frame = degraded_frame(kind, family, backgrounds, random, settings, team.vision)
        found, took = _timed(detector.detections, frame.pixels)
        seconds[0].append(took)
        seen = found.sightings if isinstance(found, Detections) else ()
        own = [one for one in seen if one.id == SUBJECT]
        recalled[0] += bool(own)
        wrong[0] += len(seen) - len(own)
        for one in own:
            for quantity, error in _errors(one, frame).items():
                errors[quantity].append(error)
        grey = cv2.cvtColor(frame.pixels, cv2.COLOR_BGR2GRAY)
        for k, peer in enumerate(peers, start=1):
            read, took = _timed(peer, grey)
            seconds[k].append(took)
            right = [one for one in read if one[0] == frame.number and frame.is_at(*one[1:])]
            recalled[k] += bool(right)
            wrong[k] += len(read) - len(right)
    own_seconds, *peers_seconds = seconds
    return Score(
        kind,
        frames,
        recalled[0],
        tuple(recalled[1:]),
        wrong[0],
        tuple(wrong[1:]),
        errors,
        own_seconds,
        tuple(peers_seconds),
    )


def false_markers(
    family: MarkerFamily, backgrounds: Sequence[Pixels], frames: int, seed: int = 1
) -> int:
    """The markers that the detector sees in parts of pictures that have none: sightings, and
    markers of nobody."""
    team, settings, random = marked_team(family), calibrated(), np.random.default_rng(seed)
    detector = CameraDetector("me", team)
    false = 0
    for _ in range(frames):
        found = detector.detections(natural_frame(backgrounds, random, settings))
        if isinstance(found, Detections):
            false += len(found.found) + len(found.ambiguities)
    return false


def _timed(look: Callable[[Any], Any], pixels: Any) -> tuple[Any, float]:
    start = time.process_time()
    found = look(pixels)
    return found, time.process_time() - start


def _errors(seen: Sighting, frame: Degraded) -> dict[str, float]:
    """The errors of a sighting in stated sigmas, by quantity."""
    stated = {
        "range": (seen.range_m, seen.range_sigma_m, frame.range_m),
        "bearing": (seen.bearing_rad, seen.bearing_sigma_rad, frame.bearing_rad),
        "heading": (seen.heading_rad, seen.heading_sigma_rad, frame.heading_rad),
    }
    errors = {}
    for quantity, (value, sigma, truth) in stated.items():
        if value is not None and sigma is not None:
            off = value - truth
            off = off if quantity == "range" else math.remainder(off, math.tau)
            errors[quantity] = abs(off) / sigma
    return errors


def natural_pictures() -> list[Pixels]:
    """The pictures that are in the package scikit-image."""
    folder = Path(import_module("skimage").__file__ or "").parent / "data"
    paths = sorted(path for path in folder.iterdir() if path.suffix in {".png", ".jpg", ".jpeg"})
    pictures = [cv2.imread(str(path), cv2.IMREAD_COLOR) for path in paths]
    return [
        p.astype(np.uint8)
        for p in pictures
        if p is not None and min(p.shape[:2]) > LEAST_PICTURE_PX
    ]


def printed(scores: Sequence[Score], peers: Sequence[str]) -> Table:
    table = Table(title=f"{scores[0].frames} frames of each kind")
    table.add_column("kind")
    headings = ["recall", *peers, "wrong", *(f"{name}'s" for name in peers)]
    headings += [f"{name[0]} 3σ" for name in QUANTITIES] + [f"{name[0]} max" for name in QUANTITIES]
    for heading in [*headings, *(f"p99 / {name}" for name in peers)]:
        table.add_column(heading, justify="right")
    for s in scores:
        own = float(np.quantile(s.seconds, 0.99))
        table.add_row(
            s.kind,
            f"{s.recall:.2f}",
            *(f"{n / s.frames:.2f}" for n in s.peers_recalled),
            str(s.wrong),
            *map(str, s.peers_wrong),
            *(f"{s.inside(q):.3f}" for q in QUANTITIES),
            *(f"{max(s.errors[q], default=0.0):.1f}" for q in QUANTITIES),
            *(f"{own / float(np.quantile(peer, 0.99)):.2f}" for peer in s.peers_seconds),
        )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=200, help="of each kind")
    parser.add_argument("--family", choices=get_args(MarkerFamily), default="apriltag_36h11")
    parser.add_argument("--kinds", default=",".join(KINDS), help="separated by commas")
    parser.add_argument("--crops", type=int, default=0, help="natural pictures without a marker")
    parser.add_argument("--landmarks", type=int, default=0, help="frames of each light, instead")
    parser.add_argument("--photographs", type=Path, help="read those of a folder instead")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("build/degraded.json"))
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    others = peers(chosen.family)
    if chosen.photographs:
        due, read = tags_read(chosen.photographs, {"own": own_reader(chosen.family)} | others)
        counts = ", ".join(f"{name} {count}" for name, count in read.items())
        Console().print(f"{due} tags in photographs, read by: {counts}")
        return
    backgrounds, readers = natural_pictures(), list(others.values())
    if chosen.landmarks:
        seen = [
            shaded_landmarks(light, chosen.landmarks, backgrounds, chosen.seed) for light in LIGHTS
        ]
        Console(width=160).print(printed_landmarks(seen))
        return
    scores = [
        measured(kind, chosen.frames, chosen.family, backgrounds, readers, chosen.seed)
        for kind in chosen.kinds.split(",")
    ]
    chosen.out.parent.mkdir(exist_ok=True)
    chosen.out.write_bytes(msgspec.json.format(msgspec.json.encode([s._asdict() for s in scores])))
    console = Console(width=160)
    console.print(printed(scores, list(others)))
    if chosen.crops:
        false = false_markers(chosen.family, backgrounds, chosen.crops, chosen.seed)
        console.print(f"{chosen.crops} natural pictures without a marker: {false} false markers")
        named, ranged = false_landmarks(backgrounds, chosen.crops, chosen.seed)
        console.print(f"the same for the team `eyes`: {named} false names, {ranged} with a range")


if __name__ == "__main__":
    main()
