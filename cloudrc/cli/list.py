"""`cloudrc list`: list the names that an experiment may use, or the releases of a cluster."""

from __future__ import annotations

import argparse
import re

from cloudrc.cli.cluster_flags import cluster_arguments
from cloudrc.cli.output import output_argument, paint, print_result
from cloudrc.errors import BadInputError
from cloudrc.text import table

PLUGINS = ("estimators", "predictors", "controllers", "metrics")
YAML = ("experiments", "missions", "profiles", "robots")
XML = ("scenes",)
KINDS = (*YAML, *PLUGINS, *XML)
RELEASES = "releases"
EPILOG = """\
examples:
  cloudrc list
  cloudrc list profiles
  cloudrc list releases -n lab
  cloudrc run --set link.profile=satellite --mode virtual"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    about = f"one of {', '.join(KINDS)}; or {RELEASES}, those of a cluster"
    choices = (*KINDS, RELEASES)
    parser.add_argument("what", nargs="?", choices=choices, metavar="WHAT", help=about)
    output_argument(parser)
    cluster_arguments(parser, "of the releases (default: all)")


def execute(options: argparse.Namespace) -> int:
    """Print name and description of each plug-in or shipped file of one kind, or of all kinds."""
    if options.what == RELEASES:
        from cloudrc.cli.releases import list_releases

        return list_releases(options)
    if options.context or options.namespace:
        raise BadInputError(f"--context and --namespace are for 'cloudrc list {RELEASES}'")
    found = {kind: describe_all(kind) for kind in ([options.what] if options.what else KINDS)}
    blocks = []
    for kind, lines in found.items():
        rows = [(f"  {name}", text) for name, text in lines.items()]
        if kind == "metrics":
            rows.append(("  ./FILE.py", "Your own: --set report.metrics=./FILE.py"))
        blocks.append(f"{paint(kind, 'bold')}\n{table(rows)}")
    entries = {
        kind: [{"name": name, "description": text} for name, text in lines.items()]
        for kind, lines in found.items()
    }
    print_result(options.output, entries, "\n\n".join(blocks))
    return 0


def describe_all(kind: str) -> dict[str, str]:
    """Return name -> description of what `cloudrc list KIND` shows, sorted by name.

    `kind` is a word such as "profiles".
    """
    from cloudrc import plugins
    from cloudrc.config import shipped

    one = kind.removesuffix("s")
    if kind in PLUGINS:
        lines = {name: plugins.describe(kind, name) for name in plugins.names(kind)}
        if kind == "metrics":
            from cloudrc.metrics import SHIPPED

            lines |= {metric.name: metric.meaning for metric in SHIPPED.values()}
    else:
        describe = shipped.describe if kind in YAML else _comment
        lines = {name: describe(one, name) for name in shipped.names(one)}
    # Remove the kind from a docstring such as "Predictor: trusts a share of the velocity."
    prefix = re.compile(rf"^[^:]*\b{one}: ", re.IGNORECASE)
    found = {name: prefix.split(line, maxsplit=1)[-1] for name, line in sorted(lines.items())}
    return {name: line[:1].upper() + line[1:].rstrip(".") for name, line in found.items()}


def _comment(kind: str, name: str) -> str:
    """Describe a scene by the first sentence of the first comment in its XML file."""
    from cloudrc.config import shipped

    text = shipped.file_of(name).read_text("utf-8")
    comment = re.search(r"<!--(.*?)-->", text, re.DOTALL)
    return " ".join(comment[1].split()).partition(". ")[0] if comment else ""
