"""A team in containers: its compose file, its image, and the run of both."""

BASE_IMAGE = "python:3.12-slim"  # what the image is built on, unless the user names another
BASE_VARIABLE = "CPCBL_BASE_IMAGE"  # where the user names it, in the environment
