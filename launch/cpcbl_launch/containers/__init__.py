"""A team in containers: its compose file, its image, and the run of both."""
