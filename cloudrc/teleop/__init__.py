# SPDX-License-Identifier: Apache-2.0

"""Missions and their API: what an operator asks becomes setpoints and requests to the robot."""
