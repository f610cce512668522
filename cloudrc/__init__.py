"""cloudrc: a testbed for robots that are controlled from the cloud."""

__version__ = "0.1.0"
