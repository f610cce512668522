"""How fast an interpreter is at its own work, for the few tests whose number is a time."""

from __future__ import annotations

import subprocess
import sys

WORK = """
from time import process_time
def work():
    table = {}
    began = process_time()
    for i in range(2_000_000):
        table[i & 1023] = i * i % 977
    return process_time() - began
print(min(work() for _ in range(5)))
"""
NOMINAL = 0.100
"""What WORK takes where a release in flight costs 138m to 148m [s]. Where it took 0.17 to 0.21 s
the same release cost 228m to 300m, all of its containers alike."""


def slower(told: str) -> float:
    """How much slower than nominal an interpreter is that has printed this for WORK; at least 1."""
    return max(1.0, float(told) / NOMINAL)


def here() -> float:
    """The same of this machine's, measured now."""
    return slower(subprocess.check_output([sys.executable, "-c", WORK], text=True))
