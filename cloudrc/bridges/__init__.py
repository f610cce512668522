"""Bridges connect cloudrc with the networks of other systems."""
