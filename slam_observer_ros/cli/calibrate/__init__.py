"""``slam-observer calibrate``: how sensor and odometry err, by a recording of a drive."""
