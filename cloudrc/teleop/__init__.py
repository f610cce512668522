"""Teleop: turn the operator's verbs into missions, setpoints and requests to the robot."""
