"""What people watch: a run, the traffic between robots, the frames of their cameras."""
