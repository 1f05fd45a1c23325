"""Velocities, their calibration, and the noise of velocities and of observed points.

Velocities are (Ω, v) (…, 6), rad/s and m/s, with covariances (…, 6, 6); ``dt_s`` and the like are
seconds; all in the body frame.
"""
