"""Recordings and data sets: ROS messages to events and back, without a ROS installation."""
