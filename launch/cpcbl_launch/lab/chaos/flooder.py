"""A process that sends too many messages in the name of a robot."""

import sys
import time

from cpcbl_agents.stop import StopSignal
from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.compact import encode_help
from cpcbl_transport.zenoh_bus import open_bus

FLOOD_RATE_HZ = 2500.0
UNSURE = (25.0, 0.0, 25.0, 0.0, 0.0, 1.0)


def main(team: str, endpoint: str, parent: str, robot: str, *targets: str) -> None:
    """`python -m cpcbl_launch.lab.chaos.flooder TEAM ENDPOINT PARENT ROBOT TARGET ...`

    Sends all that a robot may send, far more often than it may; prints the number of messages. The
    rate is bounded, because the flood of a robot on another machine would not take the processor
    from the router and the robots of this one. The messages are true, but their uncertainty is
    large, so that only their number does harm.
    """
    stop = StopSignal(int(parent))
    with open_bus(team, [endpoint], stop) as bus:
        token = bus.declare_token(topics.ALIVE.at(tier=0, robot=robot, incarnation="f"))
        keys = [topics.FIX.at(robot=name, tier=0, observer=robot) for name in targets]
        fixes = [bus.publisher(key, topics.FIX.qos) for key in keys]
        belief = bus.publisher(topics.BELIEF.at(tier=0, robot=robot), topics.BELIEF.qos)
        status = bus.publisher(topics.STATUS.at(robot=robot), topics.STATUS.qos)
        sent, begin_s = 0, time.monotonic()
        while not stop():
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
    sys.stdout.write(f"{sent}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
