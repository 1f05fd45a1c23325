"""Recordings and simulations through the estimator, and how accurate they were."""
