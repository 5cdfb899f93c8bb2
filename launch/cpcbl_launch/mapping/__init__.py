"""Landmarks and the robots' paths from logs and recordings, by sparse least squares."""
