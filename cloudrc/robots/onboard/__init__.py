"""Onboard controllers that fly or drive any robot of their kind."""
