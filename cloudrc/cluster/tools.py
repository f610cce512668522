"""The programs that are called rather than rebuilt: arguments of kubectl or helm in, text out."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from typing import IO

from cloudrc.cluster.errors import ClusterError, WaitedTooLongError
from cloudrc.errors import MissingPrerequisiteError

WHERE_TO_GET = {
    "kubectl": "https://kubernetes.io/docs/tasks/tools/",
    "helm": "https://helm.sh/docs/intro/install/",
}


def program(name: str) -> str:
    """Find a program.

    Raises:
        MissingPrerequisiteError: If it is not installed; says where it is to be had.
    """
    path = shutil.which(name)
    if path is None:
        raise MissingPrerequisiteError(f"{name} is not installed; get it: {WHERE_TO_GET[name]}")
    return path


def run(
    name: str,
    arguments: Sequence[str],
    *,
    timeout: float,
    given: str = "",
    stdout: IO[bytes] | None = None,
) -> str:
    """Run a program to its end.

    Args:
        name: "kubectl" or "helm".
        arguments: Its arguments.
        timeout: How long it may take [s].
        given: What it reads from its standard input.
        stdout: A file for what it writes; default: it is returned.

    Returns:
        What it wrote; "" if that went into a file.

    Raises:
        ClusterError: If it fails; with what it said.
        WaitedTooLongError: If it takes too long.
        MissingPrerequisiteError: If it is not installed.
    """
    command = [program(name), *arguments]
    target = subprocess.PIPE if stdout is None else stdout
    try:
        done = subprocess.run(
            command, input=given.encode(), stdout=target, stderr=subprocess.PIPE, timeout=timeout
        )
    except subprocess.TimeoutExpired as error:
        raise WaitedTooLongError(
            f"'{_short(name, arguments)}' took more than {timeout:g} s"
        ) from error
    if done.returncode != 0:
        said = last_words(done.stderr.decode(errors="replace"))
        raise ClusterError(f"'{_short(name, arguments)}' failed: {said}")
    return (done.stdout or b"").decode(errors="replace")


def last_words(stderr: str) -> str:
    """Put what a program complained about into one line, without warnings and log lines."""
    lines = [" ".join(line.split()) for line in stderr.splitlines() if line.strip()]
    first = next((i for i, line in enumerate(lines) if line.lower().startswith("error")), None)
    wanted = lines[first:] if first is not None else lines[-1:]
    text = " ".join(wanted)
    return text.removeprefix("Error: ").removeprefix("error: ") or "it left no message"


def _short(name: str, arguments: Sequence[str]) -> str:
    """The command as a person would say it: its verb and what it is about."""
    words = [word for word in arguments if not word.startswith("-")][:2]
    return " ".join([name, *words])
