"""``slam-observer replay``."""
