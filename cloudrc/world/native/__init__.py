"""The usual step in C: `step.c`, the code that loads it, and the robot that flies with it."""
