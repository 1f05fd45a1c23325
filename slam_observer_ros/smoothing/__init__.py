"""Trajectory and map in hindsight: Gauss–Newton on the group, and the equations it solves."""
