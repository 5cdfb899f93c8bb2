"""THE table of scenarios."""

from cpcbl_launch.chaos.containers import partition_containers
from cpcbl_launch.chaos.files import disk_full, read_only
from cpcbl_launch.chaos.fuzz import fuzz
from cpcbl_launch.chaos.inputs import duplicates, flood
from cpcbl_launch.chaos.network import cut_link, lossy_link, narrow_link, partition, slow_link
from cpcbl_launch.chaos.processes import (
    freeze,
    kill_field,
    kill_observer,
    kill_robot,
    kill_router,
)
from cpcbl_launch.chaos.scenario import Needs, Scenario
from cpcbl_launch.chaos.soak import soak
from cpcbl_launch.chaos.world import clock_half_second, clock_hour, hidden, kidnap, liar

QUICK, SLOW = True, False
N, ROOT, MOUNT, HYPOTHESIS = Needs.NOTHING, Needs.ROOT, Needs.MOUNT, Needs.HYPOTHESIS
DOCKER = Needs.DOCKER

SCENARIOS = (
    Scenario(
        "kill-robot",
        "kill -9 of a robot that is helped",
        "its token is gone within 1 s; the others go on; a new process within 10 s knows where it"
        " is 15 s later",
        N,
        QUICK,
        kill_robot,
    ),
    Scenario(
        "kill-observer",
        "kill -9 of the best observer, on whom a blind robot depends",
        "the same",
        N,
        SLOW,
        kill_observer,
    ),
    Scenario(
        "kill-router",
        "kill -9 of the router",
        "nobody hears anybody for 6 s at most; then all are announced, help each other and know"
        " where they are, and no robot was restarted",
        N,
        SLOW,
        kill_router,
    ),
    Scenario(
        "kill-field",
        "kill -9 of the simulated field: no inputs, then a world that begins anew",
        "robots report all the time; 20 s after the new field all know where they are",
        N,
        SLOW,
        kill_field,
    ),
    Scenario(
        "freeze",
        "the best observer is stopped (SIGSTOP) for 5 s",
        "its token is gone within 4 s; the others go on; awake it knows where it is within 5 s and"
        " nothing that it says late does harm",
        N,
        QUICK,
        freeze,
    ),
    Scenario(
        "partition",
        "two sites, a router each; the link between them is silent for 10 s",
        "each side misses the other within 4 s and goes on; one team again within 5 s of healing",
        N,
        QUICK,
        partition,
    ),
    Scenario(
        "partition-containers",
        "two sites in containers; `docker network disconnect` of one's router for 10 s",
        "the same, in containers; 1 m for the far site, whose blind scout is far from those that"
        " know best",
        DOCKER,
        SLOW,
        partition_containers,
    ),
    Scenario(
        "cut-link",
        "the best observer's link is silent for 10 s",
        "it is missed within 4 s; the others go on; it is back within 5 s",
        N,
        SLOW,
        cut_link,
    ),
    Scenario(
        "slow-link",
        "a robot's link takes 200 ms each way, 100 ms more or less, for 20 s",
        "it reports, is helped and knows where it is; the others do not notice",
        N,
        SLOW,
        slow_link,
    ),
    Scenario(
        "narrow-link",
        "a robot's link carries 50 kbit/s each way, its inputs too, for 20 s",
        "the same",
        N,
        SLOW,
        narrow_link,
    ),
    Scenario(
        "lossy-link",
        "every fifth packet of a robot's link is lost, each way, for 20 s",
        "the same, with silences of 8 s and 1 m at most, as its odometry comes in bursts",
        ROOT,
        SLOW,
        lossy_link,
    ),
    Scenario(
        "duplicates",
        "all help of the best observer comes again at once, and again up to 4 s late",
        "it is counted as duplicate or too late, and changes nothing",
        N,
        SLOW,
        duplicates,
    ),
    Scenario(
        "clock-half-second",
        "the best observer's clock is 0.5 s ahead, another's 0.05 s",
        "the one is found within 15 s, said, and its help refused; the other is tolerated",
        N,
        SLOW,
        clock_half_second,
    ),
    Scenario(
        "clock-hour",
        "the best observer's clock is an hour ahead, another's 0.05 s",
        "the same",
        N,
        SLOW,
        clock_hour,
    ),
    Scenario(
        "flood",
        "one robot says all that it may as fast as it can, fixes, beliefs, 60 kB of status",
        "the router lets 200 messages/s at most through to anybody; the others report within 2 s"
        " and know where they are",
        N,
        SLOW,
        flood,
    ),
    Scenario(
        "disk-full",
        "`up` records, reports, draws and logs onto a disk of 64 kB; prints to a full device",
        "the run goes on to its report; a line for each file that was lost; exit code 1",
        MOUNT,
        SLOW,
        disk_full,
    ),
    Scenario(
        "read-only",
        "`up` and `calibrate` are to write on a read-only file system",
        "one line names option and file before anything starts; exit code 2",
        MOUNT,
        SLOW,
        read_only,
    ),
    Scenario(
        "fuzz",
        "10,000 payloads without sense on every key (hypothesis's, random bytes, damaged ones)",
        "no process ends, nothing is thrown, each is counted by robot, field, recorder and"
        " watcher; the team goes on",
        HYPOTHESIS,
        SLOW,
        fuzz,
    ),
    Scenario(
        "kidnap",
        "a robot is carried 3 m away; its wheels do not notice",
        "it says that it is lost within 3 s, knows where it is within 8 s, and leads nobody astray",
        N,
        SLOW,
        kidnap,
    ),
    Scenario(
        "hidden-landmarks",
        "nobody sees a landmark for 60 s",
        "the team lives on what it knew and helps each other: 0.5 m at most, honest about it; well"
        " within 8 s of seeing again",
        N,
        SLOW,
        hidden,
    ),
    Scenario(
        "liar",
        "one of three observers says everything 0.7 m away, for 15 s",
        "two of the three that drive find it within 10 s (one may be out of its sight); they err by"
        " 0.15 m at most; 20 s later all believe it again",
        N,
        SLOW,
        liar,
    ),
    Scenario(
        "soak",
        "kill, freeze, cut, slow, narrow, flood, echo at random",
        "memory flat (6 MiB a process, 0.5 MiB/min), nobody silent for 30 s or stuck, nothing ends"
        " unasked, nothing left running",
        N,
        SLOW,
        soak,
    ),
)
