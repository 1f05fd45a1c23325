"""Recordings and public data sets without a ROS installation, and their messages as events."""
