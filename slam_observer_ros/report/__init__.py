"""The report of a run: one HTML file that any browser opens, without a network."""
