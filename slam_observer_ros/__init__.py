"""The SLAM_n(3) observer of Mahony and Hamel: a numpy library, ROS 2 nodes and offline tools."""

__version__ = '0.1.0'
