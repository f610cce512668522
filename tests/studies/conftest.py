"""The fixture that writes the file of a short sweep."""

from tests.support.sweeps import write_sweep

__all__ = ["write_sweep"]
