"""The robot followed: hypotheses, each a filter with its landmarks, what points may be, slips."""
