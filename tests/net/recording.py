"""Records what the project computes today: `python -m net.recording states` (or `tracks`).

It writes MessagePack to standard output. Every step has a hash; some states are kept whole.
"""

import math
import sys
from collections.abc import Iterable
from hashlib import blake2b
from pathlib import Path

import msgspec
import numpy as np
from net.canonical import Canonical, canonical_state, canonical_track
from net.scenario import FIELD, START, arrivals, with_bearings_only, without_landmarks

import cpcbl_launch
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import load_team
from cpcbl_team.config import (
    CollaborationSettings,
    LocalizationSettings,
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
    Start,
)
from cpcbl_team.inputs import Input
from cpcbl_team.localizer import Localizer
from cpcbl_team.timeline import Timeline

KEPT_STATES = 25
KEPT_TRACKS = 5
SEEDS = (1, 2, 3)
SIMULATED_S = 13.0  # the demo's robots help each other from its tenth second on
_START = Start(x_m=START.x, y_m=START.y, heading_deg=0.0)


class Run(msgspec.Struct):
    """What one configuration, or one simulated robot, went through."""

    hashes: list[str] = []
    labels: list[str] = []
    """What each step was."""
    kept: dict[int, Canonical] = {}
    """Whole states by step."""


class Recording(msgspec.Struct):
    """All runs of a kind, and how this platform computes."""

    platform: str
    runs: dict[str, Run]


def _settings(rules: LocalizerSettings) -> LocalizationSettings:
    return LocalizationSettings(localizer=rules, start=_START)


CONFIGURATIONS: dict[str, LocalizationSettings] = {
    # the seven of the benchmark
    "joint": _settings(LocalizerSettings(variant="joint")),
    "joint, alternating": _settings(LocalizerSettings(variant="joint", alternate=True)),
    "oval": _settings(LocalizerSettings(variant="oval")),
    "circular": _settings(LocalizerSettings(variant="circular")),
    "circular, bearings for heading only": _settings(
        LocalizerSettings(variant="circular", bearing_for_position=False)
    ),
    "circular, both at once": _settings(LocalizerSettings(variant="circular", alternate=False)),
    "weighted": _settings(LocalizerSettings(variant="weighted")),
    # what these leave out
    "circular, uncertainty of the paper": _settings(
        LocalizerSettings(variant="circular", paper_uncertainty=True, minimum_interval_s=0.35)
    ),
    "joint, self-calibrating": LocalizationSettings(
        localizer=LocalizerSettings(self_calibration=True),
        odometry=OdometrySettings(least_speed_m_s=0.3, crawl_sigma_m_per_sqrt_s=0.03),
        start=_START,
    ),
    "oval, correlated sensor, unknown start": LocalizationSettings(
        localizer=LocalizerSettings(variant="oval", object_interval_s=0.25),
        sensor=SensorSettings(correlation_s=0.5, max_range_for_range_m=5.0),
        collaboration=CollaborationSettings(fusion="naive"),
    ),
}


def recorded_states() -> dict[str, Run]:
    """The states after every input: each configuration on the drive, `joint` on other drives."""
    inputs = [arrival.item for arrival in arrivals()]
    runs = {name: _drive(settings, inputs) for name, settings in CONFIGURATIONS.items()}
    joint = CONFIGURATIONS["joint"]
    runs["joint, without landmarks"] = _drive(joint, without_landmarks())
    runs["joint, bearings only"] = _drive(joint, with_bearings_only())
    return runs


def _drive(settings: LocalizationSettings, inputs: Iterable[Input]) -> Run:
    localizer = Localizer(settings, FIELD)
    timeline = Timeline(localizer, localizer.start(0))
    steps = []
    for step, item in enumerate(inputs):
        refusal = timeline.add(item)
        state = canonical_state(localizer, timeline.state, with_evidence=step % KEPT_STATES == 0)
        steps.append((_label(item), {"refusal": str(refusal or ""), **state}))
    return _run(steps, KEPT_STATES)


def _label(item: Input) -> str:
    sender = getattr(item, "observer", "") or getattr(item, "robot", "")
    kind = type(item).__name__ + (f" by {sender}" if sender else "")
    return f"{kind}, {item.stamp_ns * 1e-9:.2f} s"


def recorded_tracks() -> dict[str, Run]:
    """What every robot of the demo publishes of itself, for each seed."""
    team = load_team(Path(cpcbl_launch.__file__).parent / "teams" / "demo.toml")
    runs = {}
    for seed in SEEDS:
        _, recorder = simulate(team, seed, SIMULATED_S)
        for robot, tracks in recorder.tracks.items():
            steps = [(f"{t.stamp_ns * 1e-9:.2f} s", canonical_track(t)) for t in tracks]
            runs[f"demo, seed {seed}, {robot}"] = _run(steps, KEPT_TRACKS)
    return runs


def _run(steps: list[tuple[str, Canonical]], kept_each: int) -> Run:
    hashes = [_digest(state) for _, state in steps]
    kept = {i: state for i, (_, state) in enumerate(steps) if i % kept_each == 0}
    return Run(hashes, [label for label, _ in steps], kept)


def _digest(results: object) -> str:
    """The same for the same bits, whatever the order of keys."""
    return blake2b(msgspec.msgpack.encode(results, order="sorted"), digest_size=4).hexdigest()


def platform_fingerprint() -> str:
    """A hash over results of this platform's mathematics and random numbers."""
    results = []
    for i in range(1, 200):
        x = 0.0371 * i
        results += [math.sin(x), math.cos(x), math.atan2(x, 1.7), math.exp(-x), math.log(x)]
        results += [math.hypot(x, 0.3), math.remainder(x * x, math.tau), math.tanh(x), x**1.3]
    results += np.random.default_rng(1).normal(size=200).tolist()
    return _digest(results)


if __name__ == "__main__":
    recorded = {"states": recorded_states, "tracks": recorded_tracks}[sys.argv[1]]()
    recording = Recording(platform_fingerprint(), recorded)
    sys.stdout.buffer.write(msgspec.msgpack.encode(recording))
