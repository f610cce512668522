# SPDX-License-Identifier: Apache-2.0

"""What a newcomer sees of `make demo` and `make live`; their programs only say their words."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SAYS = """#!/bin/sh
echo "$(basename "$0") $*"
echo "$REFUSAL" >&2
exit $CODE
"""


@pytest.fixture
def make(tmp_path):
    """Return a function that runs make in an environment without packages: `make(target)`."""
    (tmp_path / "bin").mkdir()
    for name in ("python", "cloudrc"):
        (tmp_path / "bin" / name).write_text(SAYS)
        (tmp_path / "bin" / name).chmod(0o755)

    def run(target, code=0, refusal="", *, installed=False):
        if installed:
            (tmp_path / "all").touch()
        # A make inside make prints the folder that it enters and leaves.
        plain = {key: value for key, value in os.environ.items() if not key.startswith("MAKE")}
        words, settings = ["make", target, f"VENV={tmp_path}"], {"CODE": str(code)}
        environment = {**plain, **settings, "REFUSAL": refusal}
        return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env=environment)

    return run


def test_the_demo_installs_in_a_few_lines_and_ends_with_the_next_commands(make, tmp_path):
    done = make("demo")
    lines = done.stdout.splitlines()
    assert done.returncode == 0, done.stderr
    assert lines.index("cloudrc run paper --mode virtual") <= 15
    live, console = (line.strip() for line in lines[-2:])
    assert live.startswith("make live ")
    assert console.startswith(f"{tmp_path}/bin/cloudrc up --console ")


def test_what_pip_refuses_is_seen(make):
    done = make("demo", code=1, refusal="ERROR: no matching distribution")
    assert done.returncode == 2
    assert "ERROR: no matching distribution" in done.stderr
    assert "cloudrc run" not in done.stdout


@pytest.mark.parametrize(("code", "last"), [(0, ""), (1, "Error 1"), (6, "with 'make demo'")])
def test_the_last_line_of_a_flight_that_was_too_slow_says_what_to_do(make, code, last):
    done = make("live", code, installed=True)
    assert done.stdout == "cloudrc run paper --mode local\n"
    assert done.returncode == (2 if code else 0)
    assert last in done.stderr.splitlines()[-1]
