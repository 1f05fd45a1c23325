"""One state that moves on: observer, gains, and which landmarks there are."""
