"""Verify a link: send probes, predict their delays and losses from the profile, and compare."""

DEFAULT = "paper"
"""Experiment whose link is verified by default, and that gets the profile to verify."""
