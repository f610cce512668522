"""Emulate the network between world and cloud by profiles, a pure model and two shapers."""
