"""Running a team: the processes of a run, their supervisor, the router, observers, containers."""
