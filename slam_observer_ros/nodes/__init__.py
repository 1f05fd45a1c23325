"""ROS 2 nodes; the only part of the package that needs rclpy and message packages.

``observer_node`` and ``lifecycle_observer_node`` are shells around ``observer_core``, which joins
``intake/`` (topics to the estimator), ``publishing/`` (the estimate to topics) and ``services/``.
``simulator_node`` publishes the paper's robot; ``demo/`` runs it with the observer. For all there
are ``runner`` (start and stop), ``ros_parameters``, ``log_bridge``, ``throttled_log``, ``qos``,
``message_classes`` and ``entities`` (what a managed node destroys again).
"""
