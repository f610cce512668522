# SPDX-License-Identifier: Apache-2.0

"""Run usual steps in C: `step.c`, the code that loads it, and a robot that uses it; `motion.c`.

In a usual step the robot follows a fresh command that the guard need not limit.
"""
