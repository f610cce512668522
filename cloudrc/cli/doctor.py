"""`cloudrc doctor`: checks this machine, line by line, and names the mend of what is missing."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from cloudrc.cli.check import Check
from cloudrc.cli.checks import all_checks
from cloudrc.cli.output import output_argument, paint, table, written
from cloudrc.errors import MissingPrerequisiteError

COLOURS = {"ok": "green", "warn": "yellow", "missing": "red"}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--mode",
        choices=("virtual", "local", "cluster"),
        default="local",
        help="the mode that you want to fly in (default: local)",
    )
    parser.add_argument("--context", metavar="NAME", help="of the cluster (default: current)")
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Print all checks; exit 3 if the wanted mode cannot run."""
    checks = list(all_checks(options.mode, options.context))
    blocking = [c.name for c in checks if c.state == "missing" and options.mode in c.modes]
    if options.output != "table":
        print(written(_document(options.mode, checks, blocking), options.output))
    else:
        print(_text(options.mode, checks, blocking))
    return MissingPrerequisiteError.exit_code if blocking else 0


def _document(mode: str, checks: list[Check], blocking: list[str]) -> dict[str, object]:
    return {
        "schemaVersion": 1,
        "mode": mode,
        "ready": not blocking,
        "checks": [asdict(check) for check in checks],
    }


def _text(mode: str, checks: list[Check], blocking: list[str]) -> str:
    needed = [c for c in checks if mode in c.modes]
    useful = [c for c in checks if mode not in c.modes]
    blocks = {f"Needed for mode {mode}:": needed, "Good to know:": useful}
    parts = [f"{title}\n{_block(block)}\n" for title, block in blocks.items() if block]
    if blocking:
        parts.append(paint(f"Mode {mode} cannot run: {', '.join(blocking)}.", "red"))
    else:
        parts.append(paint(f"Mode {mode} can run.", "green"))
    return "\n".join(parts)


def _block(checks: list[Check]) -> str:
    rows = [(check.state, check.name, check.found) for check in checks]
    lines = []
    for check, line in zip(checks, table(rows).splitlines(), strict=True):
        lines.append("  " + line.replace(check.state, paint(check.state, COLOURS[check.state]), 1))
        if check.fix:
            lines.append(f"           -> {check.fix}")
    return "\n".join(lines)
