"""Every parameter of estimator, inputs and nodes, their table and their file."""
