"""Geometry of scene and robot, without a physics engine."""
