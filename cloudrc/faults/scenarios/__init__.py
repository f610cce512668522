"""Fault scenarios in virtual time, by the part that they break."""
