"""Landmarks and teammates in camera frames. Needs OpenCV (the extra `camera`)."""
