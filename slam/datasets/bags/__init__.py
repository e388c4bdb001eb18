"""Bags of ROS 1 and ROS 2: containers, message types, topics, mounts, and the measurements in them."""
