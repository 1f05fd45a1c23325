"""Velocities, their calibration, and the noise of velocities and of observed points."""
