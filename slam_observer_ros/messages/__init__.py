"""The one boundary between ROS messages and numpy, for live topics and recordings alike.

In: decoders of serialised bytes, as rclpy's raw subscriptions and rosbags give them; a malformed
message raises a :class:`.MessageError` with the reason. Out: ``outgoing``.
"""
