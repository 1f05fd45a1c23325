"""Comparison with the truth: alignment, accuracy and consistency metrics, figures."""
