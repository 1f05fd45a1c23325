"""Every parameter: the table, the file, and those of estimator, inputs and nodes."""
