"""What points without an id may be, and whether the robot has slipped."""
