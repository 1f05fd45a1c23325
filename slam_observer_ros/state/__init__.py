"""One hypothesis: the filter, its landmarks, and the step."""
