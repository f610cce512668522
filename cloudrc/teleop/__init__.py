"""Teleop: turn the operator's commands into missions, setpoints and requests to the robot."""
