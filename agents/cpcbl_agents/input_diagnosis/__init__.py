"""What a driver probably got wrong: judged once a second by what came on a robot's inputs."""
