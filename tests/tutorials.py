# SPDX-License-Identifier: Apache-2.0

"""Play a page as its reader does: save its files, type its commands, compare what they print.

Of a tutorial, a block of `text` has lines that its commands have printed, in this order; `...`
stands for any lines. tests/support/pages.py tells the marks of blocks.
"""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from tests.conftest import wait_until
from tests.support.pages import SHELL, blocks_of, files_of

OTHER_NUMBERS = "other numbers"
"""Mark of a block of `text` whose numbers differ each time, because the commands took real time."""
FAILS = re.compile(r"FAILURE: |^\d+ success, [1-9]\d* failure|^no value is stable", re.MULTILINE)
"""What a command says that exits with 1: a mission fails, or a flight of a sweep, or a loop is
stable at no delay, as with an empty template."""
READY = "to end: "
"""Begin of the line with which a session says that commands may come."""


class Reader:
    """A person with two terminals in one folder, who `has` some of what `NEEDS` lists."""

    def __init__(self, folder, *has, **environment):
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        # PYTHONPATH is that of the tests; no page may open.
        self.environment = {**os.environ, "PATH": path, "BROWSER": "true", **environment}
        self.folder, self.said = folder, ""
        self.first = None
        self.has = {*has}

    def play(self, page, left_out=None, compares=True):
        """Play a page of the repository; blocks with the mark `left_out` are not typed.

        Neither are blocks that need what this reader does not have. With `compares`, look whether
        its blocks of text were printed.
        """
        for name, text in files_of(page).items():
            (self.folder / name).write_text(text, encoding="utf-8")
        for block in blocks_of(page):
            if block.language == "text" and compares:
                self.compare(block.body, block.mark == OTHER_NUMBERS)
            elif block.language in SHELL and block.mark != left_out and block.needs <= self.has:
                self.said = ""
                for line in block.lines:
                    self.start(line) if block.mark == "first terminal" else self.type(line)

    def type(self, line):
        """Type a line; its command may only fail if a mission or a flight of a sweep fails."""
        if line.startswith(("mkdir ", "pip install ")):
            return  # the test has a folder of its own, and all packages
        if line.startswith("cd "):
            self.folder /= line.removeprefix("cd ")
            return
        done = subprocess.run(
            ["bash", "-c", line],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        self.said += done.stdout + done.stderr
        assert done.returncode == bool(FAILS.search(done.stdout)), f"{line}\n{self.said}"

    def start(self, line):
        """Type a line in the first terminal, and wait until it is ready."""
        out = self.folder / "first.txt"
        with out.open("wb") as file:
            self.first = subprocess.Popen(
                ["bash", "-c", f"exec {line}"], cwd=self.folder, env=self.environment, stdout=file
            )
        wait_until(lambda: READY in out.read_text("utf-8") or self.first.poll() is not None)
        self.said = out.read_text("utf-8")

    def compare(self, body, is_live):
        """Check that the lines of a block were printed, one after the other."""
        shown = without_numbers if is_live else str
        rest = shown(self.said)
        for line in body.splitlines():
            if line != "...":
                _, found, rest = rest.partition(shown(line))
                assert found, f"not printed: {line}\n{self.said}"

    def leave(self):
        """End what the first terminal still does."""
        if self.first and self.first.poll() is None:
            self.first.send_signal(signal.SIGINT)
            self.first.wait(60)


def without_numbers(text):
    """Return a text in which all numbers, names of pods and blanks are equal."""
    text = re.sub(r"\b[0-9a-z]{5,10}-[0-9a-z]{5}\b", "POD", text)
    return re.sub(r"\s+", " ", re.sub(r"-?\d+(\.\d+)?", "0", text))
