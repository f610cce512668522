"""Sweeps: fly the points of a grid with several seeds, and keep one row of numbers per flight."""
