"""Programs in processes of their own."""

import subprocess
import sys


def loaded(program):
    """Return the names of all modules that a program loads."""
    words = sys.executable, "-c", f"{program}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return {*done.stdout.split()}
