"""ROS 2 nodes; the only part of the package that needs rclpy and message packages.

``observer_node``, ``lifecycle_observer_node`` and ``simulator_node`` are executables: they wait
for signals from the first instant, and load ``plain_observer``, ``managed_observer`` and
``simulator``. Both observers are shells around ``observer_core``, which joins ``intake/`` (topics
to the estimator), ``publishing/`` (the estimate to topics) and ``services/``. ``demo/`` runs the
simulator with the observer. For all there are ``stop_signal`` and ``runner`` (start and stop),
``guarded_node`` (what callbacks raise), ``ros_parameters``, ``log_bridge``, ``throttled_log``,
``qos``, ``message_classes`` and ``entities`` (what a managed node destroys again).
"""
