# SPDX-License-Identifier: Apache-2.0

"""Programs in processes of their own."""

import subprocess
import sys


def loaded(program):
    """Return the names of all modules that a program loads; it may write no error."""
    words = sys.executable, "-c", f"{program}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    return {*done.stdout.split()}
