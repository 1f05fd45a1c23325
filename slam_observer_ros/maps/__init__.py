"""Maps as they are saved and loaded, and where the robot is in one."""
