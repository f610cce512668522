# SPDX-License-Identifier: Apache-2.0

"""Run usual steps in C: the sources, the code that loads them, and a robot that uses them.

In a usual step the robot follows a fresh command that the guard need not limit. `step.c` has what
all robots share; each onboard controller has a file of its own. `motion.c` predicts the Pelican.
"""
