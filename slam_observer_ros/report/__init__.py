"""What came of a run, to be looked at: a table, JSON, and pages that need no network."""
