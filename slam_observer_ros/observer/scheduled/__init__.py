"""Scheduled gains: the covariance of a small core, and landmarks that depend on it."""
