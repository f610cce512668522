"""Verify a link: send probes, predict their delays and losses from the profile, and compare."""
