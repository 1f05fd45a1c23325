"""Lie groups of the observer: SO(3), SE(3) and SLAM_n(3), vectorised over leading axes.

Nothing here has a state, and nothing here knows ROS. Equation numbers in brackets are those of
Mahony and Hamel, *A Geometric Nonlinear Observer for Simultaneous Localisation and Mapping*.
"""
