"""Emulate the network between world and cloud: netem or a relay acts as a profile says."""
