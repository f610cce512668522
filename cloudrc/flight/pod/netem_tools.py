# SPDX-License-Identifier: Apache-2.0

"""Run tc and ip, the programs that shape the link by netem."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence

from cloudrc.link.netem import explain

_BATCH = ("tc", "-s", "-j", "-force", "-batch", "-")
_END = "qdisc show dev lo"
"""Command that follows each command to tc. Its answer, a list of qdiscs, marks the end of the
previous answer, because tc itself marks no end."""
TOOL_TIMEOUT = 5.0  # time limit of one call of tc or ip [s]


def run_tool(words: Sequence[str], environment: dict[str, str] | None = None) -> str:
    """Run a program; return its output, or raise a MissingPrerequisiteError with the remedy."""
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, env=environment, timeout=TOOL_TIMEOUT
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise explain(words, str(error), missing=isinstance(error, FileNotFoundError)) from None
    if done.returncode:
        raise explain(words, done.stderr or done.stdout or f"exit code {done.returncode}")
    return done.stdout


class Programs:
    """Runs tc and ip.

    The steps of a schedule have to take effect within milliseconds; starting a process takes
    longer. Therefore one `tc -batch -` process stays open for all changes and lists of qdiscs.
    """

    def __init__(self, tables: str = "") -> None:
        """Set `tables`, the folder in which tc looks for its tables of delays."""
        self._environment = {**os.environ, "TC_LIB_DIR": tables, "LC_ALL": "C"}
        self._tc: subprocess.Popen[str] | None = None

    def __call__(self, words: Sequence[str]) -> str:
        """Run a command of tc or ip; return its output, or raise a MissingPrerequisiteError."""
        try:
            match list(words):
                case ["tc", "qdisc", "change", *_]:
                    return self._ask(words[1:], lists=False)
                case ["tc", "-s", "-j", "qdisc", "show", *_]:
                    return self._ask(words[3:], lists=True)
        except OSError:  # tc was killed or is too old for -batch: start it for this command alone
            self.close()
        return run_tool(words, self._environment)

    def close(self) -> None:
        """Kill the open tc process, if there is one."""
        if self._tc is not None:
            self._tc.kill()
            self._tc.communicate()
            self._tc = None

    def _ask(self, words: Sequence[str], *, lists: bool) -> str:
        """Send a command to the open tc process.

        If the command `lists` qdiscs, return the list as JSON, else "". Raise an OSError if tc has
        ended.
        """
        if self._tc is None:
            stream, merged = subprocess.PIPE, subprocess.STDOUT
            self._tc = subprocess.Popen(
                _BATCH,
                1,
                stdin=stream,
                stdout=stream,
                stderr=merged,
                text=True,
                env=self._environment,
            )
        assert self._tc.stdin is not None
        assert self._tc.stdout is not None
        self._tc.stdin.write(f"{' '.join(words)}\n{_END}\n")
        self._tc.stdin.flush()
        said, listings, failed = list[str](), list[str](), False
        while len(listings) < 1 + (lists and not failed):
            if not (answer := self._tc.stdout.readline()):
                raise OSError("tc has ended")
            failed = failed or answer.startswith("Command failed")
            (listings if answer.startswith("[") else said).append(answer.strip())
        if failed:
            errors = [one for one in said if not one.startswith("Command failed")]
            raise explain(("tc", *words), " ".join(errors))
        return listings[0] if lists else ""
