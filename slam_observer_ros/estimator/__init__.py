"""Time-stamped events in, pose and map out: order, time, refusals."""
