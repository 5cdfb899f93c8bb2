"""How robots' odometry and sensors err, estimated from logs in which the truth is known."""
