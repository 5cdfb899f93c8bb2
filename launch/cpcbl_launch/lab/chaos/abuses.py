"""What a member does to its team, as a process of its own: it has the member's name, and its keys.

An abuse is a function that goes on until `stop()` and returns how many messages it sent. Its row of
the table of scenarios names it by its key in `ABUSES`.
"""

import random
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from cpcbl_agents.stop import StopSignal
from cpcbl_launch.lab.chaos import router_abuses
from cpcbl_launch.lab.chaos.abuser import Abuser
from cpcbl_launch.team.file import load_team
from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.compact import encode_help

FLOOD_RATE_HZ = 2500.0
GARBAGE_EVERY_S = 0.02
UNSURE = (25.0, 0.0, 25.0, 0.0, 0.0, 1.0)


def flood(abuser: Abuser) -> int:
    """Sends all that a robot may send, far more often than it may.

    The rate is bounded, because the flood of a robot on another machine would not take the
    processor from the router and the robots of this one. The messages are true, but their
    uncertainty is large, so that only their number does harm.
    """
    robot, targets = abuser.robot, abuser.targets
    with abuser.session() as bus:
        token = bus.declare_token(topics.ALIVE.at(tier=0, robot=robot, incarnation="f"))
        keys = [topics.FIX.at(robot=name, tier=0, observer=robot) for name in targets]
        fixes = [bus.publisher(key, topics.FIX.qos) for key in keys]
        belief = bus.publisher(topics.BELIEF.at(tier=0, robot=robot), topics.BELIEF.qos)
        status = bus.publisher(topics.STATUS.at(robot=robot), topics.STATUS.qos)
        sent, begin_s = 0, time.monotonic()
        while not abuser.stop():
            time.sleep(max(0.0, sent / FLOOD_RATE_HZ - (time.monotonic() - begin_s)))
            now_ns = time.time_ns()
            belief.put(encode_help(Belief(robot, now_ns, 4.5, 2.5, 0.0, UNSURE)))
            for name, publisher in zip(targets, fixes, strict=True):
                area = (25.0, 0.0, 25.0)
                publisher.put(encode_help(Fix(name, robot, now_ns, 4.5, 2.5, area, area)))
            sent += 1 + len(fixes)
            if sent % 100 == 0:
                status.put(bytes(60_000))
        token.close()
    return sent


def garbage(abuser: Abuser) -> int:
    """Sends payloads that are no messages on all keys on which a robot may publish."""
    robot, dice, sent = abuser.robot, random.Random(abuser.robot), 0
    of_it = topics.BELIEF, topics.LANDMARK, topics.STATUS, topics.TRACK, topics.DRIVE
    topics_of_it = (*topics.INPUTS, *of_it)
    keys = [(t.at(robot=robot, tier=0), t.qos) for t in topics_of_it]
    fixes = (topics.FIX.at(robot=name, tier=0, observer=robot) for name in abuser.targets)
    keys += [(key, topics.FIX.qos) for key in fixes]
    with abuser.session() as bus:
        publishers = [bus.publisher(key, qos) for key, qos in keys]
        while not abuser.stop():
            for publisher in publishers:
                publisher.put(b"\xff" + dice.randbytes(dice.randint(100, 300)))
            sent += len(publishers)
            time.sleep(GARBAGE_EVERY_S)
    return sent


ABUSES: Mapping[str, Callable[[Abuser], int]] = {
    "flood": flood,
    "garbage": garbage,
    "deaf": router_abuses.deaf,
    "listen": router_abuses.listen,
    "tokens": router_abuses.tokens,
    "subscriptions": router_abuses.subscriptions,
    "sessions": router_abuses.sessions,
    "half-open": router_abuses.half_open,
    "large": router_abuses.large,
}


def main(name: str, team_file: str, endpoint: str, parent: str, robot: str, *others: str) -> None:
    """`python -m cpcbl_launch.lab.chaos.abuses NAME TEAM_FILE ENDPOINT PARENT ROBOT OTHER ...`"""
    stop = StopSignal(int(parent))
    abuser = Abuser(load_team(Path(team_file)), robot, endpoint, others, stop)
    sys.stdout.write(f"{ABUSES[name](abuser)}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
