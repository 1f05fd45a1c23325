"""Measurements to events: moved into the base frame, and velocities made of poses."""
