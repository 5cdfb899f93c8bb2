"""The driver and the consumer of the docs, as processes: with a router that comes late and ends."""

import sys
from contextlib import ExitStack
from pathlib import Path

from support.processes import eventually
from support.programs import programs
from support.routers import open_router

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint

DOCS = Path(__file__).parents[2] / "docs"
TEAM = """
name = "lab"
[map.landmarks]
door = {{ x_m = 2.0, y_m = 0.2 }}
[robots.r1]
source = "external"
start = {{ x_m = 0.0, y_m = 0.0 }}
[transport]
connect = ["{endpoint}"]
"""


def test_driver_and_consumer_wait_for_a_router_and_survive_its_end(tmp_path: Path) -> None:
    endpoint, team = free_endpoint(), tmp_path / "team.toml"
    team.write_text(TEAM.format(endpoint=endpoint))
    commands = {
        "driver": (sys.executable, str(DOCS / "external_driver.py"), str(team)),
        "consumer": (sys.executable, str(DOCS / "pose_consumer.py"), str(team), "r1"),
    }
    waiting = f"waiting for a router at {endpoint}; start `cpcbl-team up` or `cpcbl-team router`"
    with ExitStack() as stack:
        clients = stack.enter_context(programs(tmp_path, **commands))
        driver, consumer = clients["driver"], clients["consumer"]
        assert eventually(lambda: waiting in driver.said and waiting in consumer.said)
        with open_router("lab", [endpoint]):
            assert eventually(lambda: f"connected to the router at {endpoint}" in driver.said)
            assert eventually(lambda: "no robot takes in/r1/odometry of team 'lab'" in driver.said)
            assert eventually(lambda: "no pose comes on pose/r1" in consumer.said)
            robot = (*PROGRAM, "robot", "r1", "--team", str(team))
            stack.enter_context(programs(tmp_path, robot=robot))
            assert eventually(lambda: len(consumer.printed) >= 5)
            assert eventually(lambda: "robot r1 takes in/r1/odometry" in driver.said)
        for client in clients.values():
            assert eventually(lambda: f"lost the router at {endpoint}" in client.said)  # noqa: B023
        before = len(consumer.printed)
        with open_router("lab", [endpoint]):
            again = f"connected to the router at {endpoint} again"
            for client in clients.values():
                assert eventually(lambda: again in client.said)  # noqa: B023
            assert eventually(lambda: len(consumer.printed) >= before + 5)
    where = [float(number) for number in consumer.printed[-1].split(" lost")[0].split()]
    assert len(where) == 3
