"""What the observer node publishes."""
