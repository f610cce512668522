# SPDX-License-Identifier: Apache-2.0

"""Teleop: turn the operator's commands into missions, setpoints and requests to the robot."""
