"""The frames that every contender of `bench_eyes` looks at: of the team `eyes`, rendered."""

from functools import lru_cache

import numpy as np
from benchmarks.rendered_frames import random_frame, render_image

from cpcbl_agents.vision.camera import Pixels
from cpcbl_launch.team.file import builtin_path, load_team

FRAMES = 24
VIEWER = "rover1"
TEAM = load_team(builtin_path("eyes"))


@lru_cache(maxsize=1)
def frames() -> tuple[Pixels, ...]:
    """What a rover's camera sees, 640 x 480: three teammates, six landmarks, some clutter, each
    anywhere, in any light."""
    found: list[Pixels] = []
    number = 0
    while len(found) < FRAMES:
        random = np.random.default_rng((5, number))
        frame = random_frame(random)
        if frame.viewer == VIEWER:
            found.append(render_image(frame, random))
        number += 1
    return tuple(found)
