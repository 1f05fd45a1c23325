"""Figures, each a PNG file; an EvaluationError is raised if one can't be written."""
