"""Geometry of scene and robot; needs no physics engine."""
