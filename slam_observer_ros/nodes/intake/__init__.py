"""From ROS messages to events."""
