"""Recordings and public data sets, read and written without a ROS installation."""
