# SPDX-License-Identifier: Apache-2.0

"""List the names that an experiment may use, with a description of each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

from cloudrc.base.text import Paint, plain, table

PLUGINS = ("estimators", "predictors", "controllers", "perceptions", "onboard", "metrics")
YAML = ("experiments", "missions", "places", "profiles", "robots")
XML = ("scenes",)
KINDS = (*YAML, *PLUGINS, *XML)
"""Kinds of what an experiment may name."""


def describe_all(kind: str) -> dict[str, str]:
    """Return name -> description of everything of a kind, sorted by name.

    `kind` is a word such as "profiles".
    """
    from cloudrc.base import plugins
    from cloudrc.config import shipped

    one = kind.removesuffix("s")
    if kind in PLUGINS:
        lines = {name: plugins.describe(kind, name) for name in plugins.names(kind)}
        if kind == "metrics":
            from cloudrc.results.metrics.descriptions import DESCRIPTIONS

            lines |= {metric: about.meaning for metric, about in DESCRIPTIONS.items()}
        elif kind == "onboard":
            lines |= _onboard_of_robots()
    else:
        describe = shipped.describe if kind in YAML else _comment
        lines = {name: describe(one, name) for name in shipped.names(one)}
    # Remove the kind from a docstring such as "Predictor: trusts a share of the velocity."
    prefix = re.compile(rf"^[^:]*\b{one}( controller)?: ", re.IGNORECASE)
    found = {name: prefix.split(line, maxsplit=1)[-1] for name, line in sorted(lines.items())}
    return {name: line[:1].upper() + line[1:].rstrip(".") for name, line in found.items()}


def _onboard_of_robots() -> dict[str, str]:
    """Describe the onboard controllers that are files of a shipped robot, such as the Pelican's."""
    from cloudrc.base import plugins
    from cloudrc.config import shipped

    files = shipped.FOLDERS["robot"].glob("*/onboard.py")
    return {"/".join(file.parts[-2:]): plugins.describe("onboard", str(file)) for file in files}


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


def settings() -> Iterator[str]:
    """Yield the beginning of each setting: KEY=NAME if the key takes names, else KEY=.

    Keys of plug-ins' parameters are left out.
    """
    from cloudrc.base import plugins
    from cloudrc.config import shipped
    from cloudrc.config.keys import plain_keys
    from cloudrc.config.overrides import KINDS as PLUGIN_KINDS
    from cloudrc.config.schema import Experiment

    named: dict[str, Sequence[str]] = {
        **{f"cloud.{key}": plugins.names(kind) for key, kind in PLUGIN_KINDS.items()},
        **{f"world.{kind}": shipped.names(kind) for kind in ("robot", "scene")},
        "link.profile": shipped.names("profile"),
        "mission": shipped.names("mission"),
        "cloud.place": shipped.names("place"),
    }
    keys = plain_keys(Experiment)
    keys |= {key.replace("uplink", "both") for key in keys if key.startswith("link.uplink.")}
    yield from (f"{key}=" for key in sorted(keys - set(named)) if not key.endswith(".name"))
    yield from sorted(f"{key}={name}" for key, names in named.items() for name in names)
