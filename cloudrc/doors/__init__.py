# SPDX-License-Identifier: Apache-2.0

"""How people and programs get in: commands, Python, the browser, ROS 2."""
