"""Runs: fly experiments, sweep settings, compare and measure them, from commands and programs."""
