"""Faults with real processes, signals and sockets on this machine."""
