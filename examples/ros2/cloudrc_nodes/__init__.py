"""Nodes of ROS 2 that control a robot of cloudrc. They do not import cloudrc."""
