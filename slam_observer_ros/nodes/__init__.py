"""ROS 2 nodes; the only part of the package that needs rclpy and message packages.

``executables`` wait for signals from the first instant (``common/process``), then load a node and
give it to ``runner``. ``observer_nodes`` has the observer, plain and managed; ``services`` and
``initial_pose`` steer it. ``simulator`` is the paper's simulation. All use ``ros_node``.
"""
