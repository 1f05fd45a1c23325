"""What points without an id, or with a suspect one, may be, and where the robot is then."""
