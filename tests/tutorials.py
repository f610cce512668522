"""Play a tutorial as its reader does: save its files, type its commands, compare what they print.

A block of `bash` is typed line by line; one of `sh` is not. A block of `text` has lines that its
commands have printed, in this order; `...` stands for any lines. A mark before a block says more.
"""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from tests.conftest import wait_until

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "tutorials"
BLOCK = re.compile(r"(?:<!-- test: ([^\n]+) -->\n)?```(\w+)\n(.*?)```", re.DOTALL)
OTHER_NUMBERS = "other numbers"
"""Mark of a block of `text` whose numbers differ each time, because the commands took real time."""
READY = "to end: "
"""Begin of the line with which a session says that commands may come."""


class Reader:
    """A person with two terminals in one folder."""

    def __init__(self, folder, **environment):
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        # PYTHONPATH is that of the tests; no page may open.
        self.environment = {**os.environ, "PATH": path, "BROWSER": "true", **environment}
        self.folder, self.said = folder, ""
        self.first = None

    def play(self, name, left_out=""):
        """Play a tutorial; blocks with the mark `left_out` are not typed."""
        for mark, language, body in BLOCK.findall((FOLDER / f"{name}.md").read_text("utf-8")):
            if mark and mark == left_out:
                continue
            if language == "text":
                self.compare(body, mark == OTHER_NUMBERS)
            elif language == "bash":
                self.said = ""
                for line in body.replace("\\\n", "").splitlines():
                    self.start(line) if mark == "first terminal" else self.type(line)
            elif mark:
                (self.folder / mark).write_text(body, encoding="utf-8")

    def type(self, line):
        """Type a line; its command may only fail if a mission fails."""
        if line.startswith("mkdir "):
            return  # the test has a folder of its own
        done = subprocess.run(
            ["bash", "-c", line],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        self.said += done.stdout + done.stderr
        assert done.returncode == ("FAILURE: " in done.stdout), f"{line}\n{self.said}"

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
