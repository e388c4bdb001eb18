"""Bags of ROS 1 and ROS 2: containers, message types, topics, sensor poses and measurements."""
