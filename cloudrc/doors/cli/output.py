# SPDX-License-Identifier: Apache-2.0

"""Output of commands: tables and colour for people, JSON and YAML for programs."""

from __future__ import annotations

import codecs
import contextlib
import io
import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from cloudrc.base.errors import DISK_FULL
from cloudrc.base.files import at_place
from cloudrc.base.text import escape
from cloudrc.doors.cli.parser import Parser

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment
    from cloudrc.flight.trials.plan import SweepPlan

_CODES = {"green": "32", "yellow": "33", "red": "31", "bold": "1"}

_SUBSTITUTES = {"±": "+-", "²": "^2", "·": "-", "π": "pi"}
"""Sign -> text in an output whose encoding lacks the sign."""

TABLE = "table"
"""Form of the output that is for people."""
TABLES = ("csv", "latex")
"""Further forms of a command whose result is a table."""
TERMINATION_LOG = Path("/dev/termination-log")
"""File in a pod for the pod's last message, which `kubectl describe` shows after the pod's end."""
STDOUT = "the output (stdout)"
"""Place of the output in errors."""


def output_argument(
    parser: Parser, what: str = "output format", *, forms: Sequence[str] = ()
) -> None:
    """Declare the flag `--output`; `what` is its help text, `forms` are further forms."""
    forms, about = (TABLE, "json", "yaml", *forms), f"{what} (default: table)"
    parser.add_argument("-o", "--output", choices=forms, default=TABLE, help=about)


def format_document(document: object, form: str) -> str:
    """Return plain values as text; `form` is "json" or "yaml"."""
    text = json.dumps(document, indent=2)  # escaped: a terminal must not obey control characters
    if form == "json":
        return text
    from cloudrc.base.outside.document import write_yaml

    return write_yaml(json.loads(text)).rstrip("\n")


def print_result(form: str, document: Mapping[str, Any], text: str, **others: str) -> None:
    """Print the result of a command: `text` if `form` is "table", else the document in this form.

    `others` are the texts of further forms.
    The document begins with the version of its schema. Print nothing if the reader closed the pipe.
    Raise an OSError if stdout is a file on a full disk, because the result is then incomplete.
    """
    shown = {TABLE: text, **others}.get(form)
    if shown is None:
        shown = format_document({"schemaVersion": 1, **document}, form)
    try:
        with at_place(STDOUT):
            print(shown, flush=True)
    except OSError as error:
        discard_output(sys.stdout)
        if error.errno in DISK_FULL:
            raise


def open_streams() -> None:
    """Let stdout and stderr take every text: a closed one drops it, others write substitutes.

    An encoding such as ISO 8859-2 has no ±, and file names may have bytes that are no text.
    """
    codecs.register_error("substitute", _substitute)
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by the shell, so no file of ours may get its descriptor
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))
        elif name != "stdin" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="substitute")


def _substitute(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end]
    return "".join(_SUBSTITUTES.get(sign, "?") for sign in text), error.end


@contextlib.contextmanager
def reserve_stdout() -> Iterator[None]:
    """Let only `sys.stdout` write to stdout; inside the block, descriptor 1 is that of stderr.

    So child processes and C libraries of a plug-in do not write into a document.
    """
    stdout = sys.stdout
    if (number := _descriptor(stdout)) is None:
        yield
        return
    stdout.flush()
    with open(os.dup(number), "w", encoding=stdout.encoding, errors=stdout.errors) as document:
        os.dup2(sys.stderr.fileno(), number)
        try:
            with contextlib.redirect_stdout(document):
                yield
        finally:
            os.dup2(document.fileno(), number)


def is_live(stream: TextIO) -> bool:
    """Return whether a stream is a terminal that can rewrite a line in place."""
    dull = os.environ.get("TERM", "") in ("", "dumb") or bool(os.environ.get("CI"))
    return stream.isatty() and not dull


def print_or_drop(text: str, stream: TextIO | None = None) -> None:
    """Print a text (default: on stdout) and flush; print nothing if the reader closed the pipe."""
    stream = stream or sys.stdout
    try:
        print(text, file=stream, flush=True)
    except OSError:
        discard_output(stream)


def discard_output(stream: TextIO) -> None:
    """Redirect a closed stream to /dev/null, so that Python's flush at exit raises no error."""
    if (number := _descriptor(stream)) is not None:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, number)
        os.close(null)


def _descriptor(stream: TextIO) -> int | None:
    """Return the descriptor of a stream; None for a closed one and for that of a test."""
    with contextlib.suppress(OSError, ValueError):
        return stream.fileno()
    return None


def leave_message(text: str) -> None:
    """Leave one line about the end of this pod, which Kubernetes keeps with the pod's state."""
    if os.access(TERMINATION_LOG, os.W_OK):
        TERMINATION_LOG.write_text(f"{escape(text)}\n", encoding="utf-8")


def open_page(url: str) -> bool:
    """Open a page in the user's browser; return False if there is no browser with a window.

    Without a window, `webbrowser` could start a text browser in the terminal of the command.
    """
    import webbrowser

    wanted = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    has_window = sys.platform != "linux" or any(os.environ.get(name) for name in wanted)
    return has_window and webbrowser.open(url)


def paint(text: str, colour: str) -> str:
    """Return the text with colour codes if stdout is a terminal, else unchanged."""
    if os.environ.get("NO_COLOR") or not is_live(sys.stdout):
        return text
    return f"\x1b[{_CODES[colour]}m{text}\x1b[0m"


def print_line(line: str, stream: TextIO | None = None) -> None:
    """Print a line with unprintable characters escaped (default: on stdout), and flush at once."""
    with at_place(STDOUT):  # if stderr fails, nobody reads the error
        print(escape(line), file=stream, flush=True)


def print_lines(lines: Iterable[str], stream: TextIO | None = None) -> None:
    """Print lines as `print_line` does."""
    for line in lines:
        print_line(line, stream)


def tell(text: str) -> None:
    """Print a line about the work of this command, such as a note, on stderr."""
    print_line(f"cloudrc: {text}", sys.stderr)


def again(out: Path | None, folder: Path) -> str:
    """Say how to continue with `folder` after a command has ended early; `out` is its --out."""
    return "to continue, give the same command again" if out else f"to continue, add --out {folder}"


def warn_about(plan: SweepPlan) -> None:
    """Print warnings about the points of a plan on stderr, and where the speed cap changes."""
    warn(*plan.points, seeds=len(plan.draft.seeds))
    if plan.speed_caps:
        tell(plan.speed_caps)


def warn(*experiments: ResolvedExperiment, seeds: int = 1) -> None:
    """Print warnings about experiments that fly with so many seeds on stderr."""
    from cloudrc.flight.experiment import advice_on

    print_lines((f"cloudrc: warning: {text}" for text in advice_on(*experiments)), sys.stderr)
    warn_of_few_seeds(seeds, *experiments)


def warn_of_few_seeds(seeds: int, *experiments: ResolvedExperiment) -> None:
    """Say if several seeds fly over one and the same part of a schedule."""
    from cloudrc.config.link_schedule import describe_one_schedule

    if text := describe_one_schedule(seeds, *experiments):
        tell(text)
