"""Recordings and simulations through the estimator, and how accurate they were.

Poses (…, 4, 4) are body to world; points are in the world, metres; stamps are int nanoseconds.
"""
