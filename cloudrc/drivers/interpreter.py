"""Python again: what a process of its own is to run goes in, the words of its command come out."""

from __future__ import annotations

import os
import sys


def interpreter(*words: str) -> list[str]:
    """Put this interpreter before its words, as `-m cloudrc relay`.

    Python looks into the working folder first, which may be a run got from somebody else: the new
    process does so only if this one does, as below `python -m`.
    """
    here = os.getcwd() in sys.path or "" in sys.path
    return [sys.executable, *(() if here else ("-P",)), *words]
