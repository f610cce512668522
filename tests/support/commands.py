# SPDX-License-Identifier: Apache-2.0

"""Python as a process of its own."""

import subprocess
import sys


def python(*words, **how):
    """Run Python with these words to its end; return the process, with its texts."""
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, **how)
