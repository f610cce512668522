# SPDX-License-Identifier: Apache-2.0

"""Run usual steps of the robot in C: `step.c`, the code that loads it, and a robot that uses it.

In a usual step the robot follows a fresh command that the guard need not limit.
"""
