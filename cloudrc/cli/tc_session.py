"""tc kept running: commands go in as lines, answers come out without starting a process for each.

A step of a time line has to be in force within milliseconds, and a process takes longer than that
to start. `tc -batch -` reads its commands from a pipe and answers each as soon as it is done; after
each a listing is asked for, whose line marks the end of the answer.
"""

from __future__ import annotations

import os
import select
import subprocess
import time
from collections.abc import Mapping, Sequence

from cloudrc.link.tc import Answer

PATIENCE = 5.0
"""How long tc and ip may take [s]."""
NOT_FOUND = 127
_FAILED = b"Command failed -:"
_PIPE = 65_536
_BATCH = ("tc", "-s", "-j", "-force", "-batch", "-")
_END = "qdisc show dev lo"


def runner(tables: str, prefix: Sequence[str] = ()) -> Programs:
    """Make what runs tc and ip.

    Args:
        tables: Folder in which tc finds its distributions.
        prefix: Words before each program, such as "ip netns exec NAME".
    """
    return Programs({**os.environ, "TC_LIB_DIR": tables, "LC_ALL": "C"}, prefix)


class Programs:
    """Runs tc and ip; changes and listings of qdiscs through one tc that keeps running."""

    def __init__(self, environment: Mapping[str, str], prefix: Sequence[str] = ()) -> None:
        """Start nothing yet."""
        self._environment, self._prefix = environment, tuple(prefix)
        self._session: Session | None = None

    def __call__(self, words: Sequence[str]) -> Answer:
        """Run a program to its end."""
        line = _for_batch(words)
        if line is None:
            return self._once(words)
        try:
            if self._session is None:
                self._session = Session((*self._prefix, *_BATCH), self._environment)
            return self._session.ask(line, lists=words[1].startswith("-"))
        except (OSError, SessionError):
            # It was killed, or is too old for this: once more, as everybody does it.
            self.close()
            return self._once(words)

    def close(self) -> None:
        """End the tc that keeps running, if there is one."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def _once(self, words: Sequence[str]) -> Answer:
        try:
            done = subprocess.run(
                (*self._prefix, *words),
                capture_output=True,
                text=True,
                env=self._environment,
                timeout=PATIENCE,
                check=False,
            )
        except FileNotFoundError:
            return Answer(NOT_FOUND, "", "")
        except OSError as error:  # no leave to run it, or no process left
            return Answer(1, "", error.strerror or str(error))
        except subprocess.TimeoutExpired:
            return Answer(1, "", f"no answer within {PATIENCE:g} s")
        return Answer(done.returncode, done.stdout, done.stderr)


class SessionError(Exception):
    """The tc that keeps running does not answer as expected."""


class Session:
    """One `tc -batch -`."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        """Start it; raises an OSError."""
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._in, self._out = self._process.stdin.fileno(), self._process.stdout.fileno()

    def ask(self, line: str, *, lists: bool) -> Answer:
        """Have one command done.

        Args:
            line: The words after `tc`, options left out.
            lists: Whether a line of JSON is its answer; else it says nothing if all is well.

        Raises:
            SessionError: If there is no answer, or none that makes sense; then close it.
        """
        os.write(self._in, f"{line}\n{_END}\n".encode())
        until, said, answer = time.monotonic() + PATIENCE, b"", ""
        listings: list[str] = []
        complaints: list[str] = []
        while len(listings) < (2 if lists and not complaints else 1):
            end = said.find(b"\n")
            if end < 0:
                said += self._read(until)
                continue
            one, said = said[:end], said[end + 1 :]
            if one.startswith(_FAILED):
                complaints.append("")
            elif one.startswith(b"["):
                listings.append(one.decode())
            elif one.strip():
                answer += one.decode(errors="replace") + "\n"
        if complaints:
            return Answer(2, "", answer)
        return Answer(0, listings[0] if lists else answer, "")

    def _read(self, until: float) -> bytes:
        ready, _, _ = select.select([self._out], [], [], max(0.0, until - time.monotonic()))
        said = os.read(self._out, _PIPE) if ready else b""
        if not said:
            raise SessionError("it has ended" if ready else "no answer")
        return said

    def close(self) -> None:
        """End it."""
        process = self._process
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()


def _for_batch(words: Sequence[str]) -> str | None:
    """Put a command into a line for the tc that keeps running; None if that is not worth it."""
    match list(words):
        case ["tc", "qdisc", "change", *rest]:
            return " ".join(["qdisc", "change", *rest])
        case ["tc", "-s", "-j", "qdisc", "show", *rest]:
            return " ".join(["qdisc", "show", *rest])
    return None
