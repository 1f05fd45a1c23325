"""Comparison with the truth: alignment, accuracy and consistency metrics, figures.

Poses (…, 4, 4) are body to world; points are in the world, metres; stamps are int nanoseconds.
"""
