"""The table of all fault scenarios: what is done, what is expected, and what it needs."""

from cpcbl_launch.lab.chaos import network, processes, world
from cpcbl_launch.lab.chaos.containers import missing_docker, partition_containers
from cpcbl_launch.lab.chaos.files import disk_full, missing_mount, read_only
from cpcbl_launch.lab.chaos.links import missing_tun
from cpcbl_launch.lab.chaos.scenario import Requirement, Scenario
from cpcbl_launch.lab.chaos.soak import soak

TUN = Requirement("root and /dev/net/tun", missing_tun)
MOUNT = Requirement("root, to mount a small disk", missing_mount)
DOCKER = Requirement("docker", missing_docker)

SCENARIOS = (
    Scenario(
        "kill-robot",
        "a robot that receives help is killed (SIGKILL)",
        "its liveliness token disappears within 1 s; the other robots continue; a new process"
        " starts within 10 s and is localized within another 15 s",
        processes.KILL_ROBOT.run,
        quick=True,
    ),
    Scenario(
        "kill-observer",
        "the best observer, on which a blind robot depends, is killed (SIGKILL)",
        "the same as for kill-robot",
        processes.KILL_OBSERVER.run,
    ),
    Scenario(
        "kill-router",
        "the router is killed (SIGKILL)",
        "no robot receives anything for at most 6 s; then all robots have a liveliness token"
        " again, help each other and are localized, and no robot was restarted",
        processes.KILL_ROUTER.run,
    ),
    Scenario(
        "kill-field",
        "the simulated field is killed (SIGKILL): robots get no inputs, then a new simulated"
        " world starts",
        "the robots publish their tracks all the time; 20 s after the new field started, all"
        " robots are localized",
        processes.KILL_FIELD.run,
    ),
    Scenario(
        "freeze",
        "the best observer is stopped for 5 s (SIGSTOP)",
        "its liveliness token disappears within 4 s; the other robots continue; after it wakes"
        " it is localized within 5 s, and the messages that it sends late do no harm",
        processes.FREEZE.run,
        quick=True,
    ),
    Scenario(
        "partition",
        "the team is at two sites with one router each; the link between the routers is silent"
        " for 10 s",
        "each side notices within 4 s that the other is missing, and continues; within 5 s of"
        " healing they are one team again",
        network.PARTITION.run,
        quick=True,
    ),
    Scenario(
        "partition-containers",
        "the team is at two sites, in containers; `docker network disconnect` takes the router"
        " of one site off the link for 10 s",
        "the same as for partition, but the RMSE of the far site may be up to 1 m, because its"
        " blind scout is far from the robots with the best estimates",
        partition_containers,
        needs=DOCKER,
    ),
    Scenario(
        "cut-link",
        "the link of the best observer is silent for 10 s",
        "the other robots notice within 4 s that it is missing, and continue; its token is back"
        " within 5 s",
        network.CUT_LINK.run,
    ),
    Scenario(
        "slow-link",
        "the link of a robot delays by 200 ms in each direction, with 100 ms of jitter, for 20 s",
        "the robot publishes its tracks, receives help and stays localized; the other robots"
        " are not affected",
        network.SLOW_LINK.run,
    ),
    Scenario(
        "narrow-link",
        "the link of a robot, which also carries its inputs, is limited to 50 kbit/s in each"
        " direction for 20 s",
        "the same as for slow-link",
        network.NARROW_LINK.run,
    ),
    Scenario(
        "lossy-link",
        "the link of a robot loses every fifth packet in each direction for 20 s",
        "the same as for slow-link, with gaps of up to 8 s and an RMSE of up to 1 m, because"
        " its odometry arrives in bursts",
        network.LOSSY_LINK.run,
        needs=TUN,
    ),
    Scenario(
        "duplicates",
        "each help message of the best observer is repeated at once, and again up to 4 s late",
        "the copies are counted as duplicate or too late, and change nothing",
        network.DUPLICATES.run,
    ),
    Scenario(
        "clock-half-second",
        "the clock of the best observer is 0.5 s ahead, that of another robot 0.05 s",
        "the other robots detect the first error within 15 s, report it and refuse the"
        " observer's help; they tolerate the second",
        world.wrong_clock(0.5).run,
    ),
    Scenario(
        "clock-hour",
        "the clock of the best observer is one hour ahead, that of another robot 0.05 s",
        "the same as for clock-half-second",
        world.wrong_clock(3600.0).run,
    ),
    Scenario(
        "flood",
        "one robot sends everything that it may send 2,500 times a second: fixes, beliefs, status"
        " messages of 60 kB",
        "the router lets at most 200 messages/s through to any robot; the other robots publish"
        " with gaps of at most 2 s and stay localized",
        network.FLOOD.run,
    ),
    Scenario(
        "disk-full",
        "`up` writes its recording, report, picture and logs onto a disk of 64 kB, and its"
        " output to a full device",
        "the run continues to its report; one line names each file that could not be written;"
        " exit code 1",
        disk_full,
        needs=MOUNT,
    ),
    Scenario(
        "read-only",
        "`up` and `calibrate` are told to write to a read-only file system",
        "one line names the option and the file before anything starts; exit code 2",
        read_only,
        needs=MOUNT,
    ),
    Scenario(
        "kidnap",
        "a robot is moved by 3 m without any odometry",
        "it reports within 3 s that it is lost, is localized within 8 s, and does not mislead"
        " any teammate",
        world.KIDNAP.run,
    ),
    Scenario(
        "hidden-landmarks",
        "no robot sees a landmark for 60 s",
        "the robots continue on odometry and help each other: the RMSE is at most 0.5 m, and"
        " the stated uncertainty is consistent; within 8 s of seeing landmarks again all are"
        " localized",
        world.HIDDEN_LANDMARKS.run,
    ),
    Scenario(
        "liar",
        "one of three observers reports every position 0.7 m wrong for 15 s",
        "two of the three driving robots detect it within 10 s (one may be out of its sight);"
        " their RMSE is at most 0.15 m; 20 s later all robots trust it again",
        world.FAULTY_ROBOT.run,
    ),
    Scenario(
        "soak",
        "kill, freeze, cut, slow, narrow, flood and echo faults in random order",
        "memory does not grow (6 MiB a process, 0.5 MiB/min); no robot is silent for 30 s or"
        " stays lost; no process ends without being killed; no process is left behind",
        soak,
    ),
)
