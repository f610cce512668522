"""List the names that an experiment may use, with a description of each."""

from __future__ import annotations

import re
from collections.abc import Mapping

from cloudrc.text import Paint, plain, table

PLUGINS = ("estimators", "predictors", "controllers", "metrics")
YAML = ("experiments", "missions", "profiles", "robots")
XML = ("scenes",)
KINDS = (*YAML, *PLUGINS, *XML)
"""Kinds of what an experiment may name."""


def describe_all(kind: str) -> dict[str, str]:
    """Return name -> description of everything of a kind, sorted by name.

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


def as_text(found: Mapping[str, Mapping[str, str]], paint: Paint = plain) -> str:
    """Format kind -> name -> description as one table per kind."""
    blocks = []
    for kind, lines in found.items():
        rows = [(f"  {name}", text) for name, text in lines.items()]
        if kind == "metrics":
            rows.append(("  ./FILE.py", "Your own: --set report.metrics=./FILE.py"))
        blocks.append(f"{paint(kind, 'bold')}\n{table(rows)}")
    return "\n\n".join(blocks)
