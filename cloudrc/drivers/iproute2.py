"""Run tc and ip as processes.

A step of a time line must take effect within milliseconds, and starting a process takes longer.
Therefore one `tc -batch -` keeps running and reads commands from a pipe. After each command this
module requests a listing of one line, which marks the end of the command's answer.
"""

from __future__ import annotations

import os
import select
import subprocess
import time
from collections.abc import Sequence

from cloudrc.link.netem import NOT_FOUND, Answer

TOOL_TIMEOUT = 5.0
"""Time limit of one call of tc or ip [s]."""
_BATCH = ("tc", "-s", "-j", "-force", "-batch", "-")
_END = "qdisc show dev lo"
"""Command whose answer of one line marks the end of the answer before."""


class Programs:
    """Runs tc and ip; one lasting tc process makes all changes and listings of qdiscs."""

    def __init__(self, tables: str = "", prefix: Sequence[str] = ()) -> None:
        """Store the settings; start no process.

        Args:
            tables: Folder with the distribution tables of tc.
            prefix: Words before each command, such as "ip netns exec NAME".
        """
        self._environment = {**os.environ, "TC_LIB_DIR": tables, "LC_ALL": "C"}
        self._prefix = tuple(prefix)
        self._tc: subprocess.Popen[bytes] | None = None

    def __call__(self, words: Sequence[str]) -> Answer:
        """Run a command and return its answer."""
        match list(words):
            case ["tc", "qdisc", "change", *_]:
                line, lists = " ".join(words[1:]), False
            case ["tc", "-s", "-j", "qdisc", "show", *_]:
                line, lists = " ".join(words[3:]), True
            case _:
                return self._once(words)
        try:
            return self._ask(line, lists)
        except OSError:  # killed, or too old for -batch: start one for this command
            self.close()
            return self._once(words)

    def close(self) -> None:
        """End the lasting tc process, if there is one."""
        if self._tc is not None:
            self._tc.kill()
            self._tc.communicate()
            self._tc = None

    def _once(self, words: Sequence[str]) -> Answer:
        try:
            done = subprocess.run(
                (*self._prefix, *words),
                capture_output=True,
                text=True,
                env=self._environment,
                timeout=TOOL_TIMEOUT,
                check=False,
            )
        except FileNotFoundError:
            return Answer(NOT_FOUND, "", "")
        except OSError as error:  # no permission, or the limit of processes is reached
            return Answer(1, "", error.strerror or str(error))
        except subprocess.TimeoutExpired:
            return Answer(1, "", f"no answer within {TOOL_TIMEOUT:g} s")
        return Answer(done.returncode, done.stdout, done.stderr)

    def _ask(self, line: str, lists: bool) -> Answer:
        """Send a line to the lasting tc; raise an OSError if tc does not answer."""
        if self._tc is None:
            self._tc = subprocess.Popen(
                (*self._prefix, *_BATCH),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=self._environment,
                bufsize=0,
            )
        assert self._tc.stdin is not None
        assert self._tc.stdout is not None
        self._tc.stdin.write(f"{line}\n{_END}\n".encode())
        deadline, text, failed = time.monotonic() + TOOL_TIMEOUT, b"", False
        while True:
            lines = text.splitlines() if text.endswith(b"\n") else []
            failed = any(one.startswith(b"Command failed -:") for one in lines)
            listings = [one.decode() for one in lines if one.startswith(b"[")]
            if len(listings) == 1 + (lists and not failed):
                break
            ready, _, _ = select.select([self._tc.stdout], [], [], deadline - time.monotonic())
            data = self._tc.stdout.read(1 << 16) if ready else b""
            if not data:
                raise OSError("tc has ended" if ready else "no answer of tc")
            text += data
        rest = [one.decode(errors="replace") for one in lines if one[:1] not in (b"[", b"C")]
        return (
            Answer(2, "", "\n".join(rest))
            if failed
            else Answer(0, listings[0] if lists else "", "")
        )
