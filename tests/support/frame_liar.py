"""A robot of the team that says that it is in a frame which nobody has begun, and tells each other
robot another pose there."""

import math
import random
from collections.abc import Sequence

from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Fix
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle
from cpcbl_transport.compact import encode_help
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import Truth, Truths
from cpcbl_transport.topics import ANY_TIER, tier_chunk

PERIOD_NS = 100_000_000


class FrameLiar:
    """A node of `run_nodes`. It sends each victim ten fixes a second, as certain as the best. The
    poses that it tells are rigid moves of the true ones, another one for each victim."""

    def __init__(
        self, bus: Bus, name: str, victims: Sequence[str], frames: Sequence[str], seed: int
    ) -> None:
        """`frames`: as in keys; with several, it is in another one each three seconds."""
        self.next_ns, self.waiting = 0, False
        self._bus, self._name, self._frames = bus, name, frames
        self._frame, self._tokens, self._truths = "", list[Handle](), list[Truth]()
        self._stamp_ns = 0
        self._subscriber = Subscriber(bus, Truths, self._on_truths)
        dice = random.Random(f"{name} {seed}")
        self._moved = {v: Pose2(*(dice.uniform(-3.0, 3.0) for _ in "xyh")) for v in victims}

    def _on_truths(self, received: Received[Truths]) -> None:
        self._stamp_ns, self._truths = received.message.stamp_ns, list(received.message.robots)

    def step(self, now_ns: int) -> None:
        self.next_ns = now_ns + PERIOD_NS
        frame = self._frames[min(now_ns // 3_000_000_000, len(self._frames) - 1)]
        if frame != self._frame:
            self._announce(frame)
        in_key = "" if frame == "field" else frame
        for truth in self._truths:
            if truth.robot in self._moved:
                fix = encode_help(self._fix(truth))
                for tier in (ANY_TIER, 0):
                    chunk = tier_chunk(tier, in_key)
                    key = topics.FIX.at(robot=truth.robot, tier=chunk, observer=self._name)
                    self._bus.publisher(key, topics.FIX.qos).put(fix)

    def _announce(self, frame: str) -> None:
        own, old = {"robot": self._name, "incarnation": "0"}, self._tokens
        self._frame = frame
        alive = tier_chunk(0, "" if frame == "field" else frame)
        keys = topics.ALIVE.at(tier=alive, **own), topics.FRAME.at(frame=frame, **own)
        self._tokens = [self._bus.declare_token(key) for key in keys]
        for token in old:
            token.close()

    def _fix(self, truth: Truth) -> Fix:
        pose = self._moved[truth.robot] @ Pose2(truth.x_m, truth.y_m, truth.heading_rad)
        part, turn = (5e-5, 0.0, 5e-5), math.radians(1.0) ** 2
        heading = math.remainder(pose.heading, math.tau)
        who = truth.robot, self._name, self._stamp_ns
        return Fix(*who, pose.x, pose.y, part, part, heading, turn, turn)
