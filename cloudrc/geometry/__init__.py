"""Geometry of scene and robot without a physics engine: what is where, and how near."""
