"""Emulate the network between world and cloud, defined by a profile, by netem or a relay."""
