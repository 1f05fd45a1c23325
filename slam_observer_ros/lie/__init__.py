"""Lie groups of the observer: SO(3), SE(3) and SLAM_n(3), vectorised over leading axes.

R (…, 3, 3) rotates, T (…, 4, 4) is a pose (3), ξ (…, 6) a twist (Ω, v), points are (…, n, 3);
metres, radians, seconds. Nothing here has a state or knows ROS. Numbers in brackets are equations
of Mahony and Hamel, *A Geometric Nonlinear Observer for Simultaneous Localisation and Mapping*.
"""
