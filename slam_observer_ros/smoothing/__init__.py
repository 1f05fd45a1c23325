"""Smoothed trajectory and map: Gauss–Newton on the group, and the equations it solves."""
