"""The one boundary between ROS messages and numpy, for live topics and recordings alike.

Decoders take a message as serialised bytes, which rclpy's raw subscriptions and rosbags' raw data
give alike; a malformed message raises :class:`.MessageError` with the reason.
"""
