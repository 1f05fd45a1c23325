"""``slam-observer batch``: many recordings with many settings."""
