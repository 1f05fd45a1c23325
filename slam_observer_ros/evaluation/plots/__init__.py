"""Figures, as PNG, SVG or PDF; an EvaluationError is raised if one can't be written."""
