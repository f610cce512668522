"""Fly many points of a grid, and answer questions with the results."""
