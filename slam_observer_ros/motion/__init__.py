"""How the robot moves: velocities, how they are calibrated, and their noise."""
