"""Write every generated file: `make docs` runs it, a test compares each file with it.

The tables of docs/experiment.md come from the models of `cloudrc/config/schema.py` and the
signatures of the shipped plug-ins, those of docs/topics.md from `cloudrc/record/topics.py`; the
text above the tables is written by hand. docs/metrics.md comes from `cloudrc/exposition/table.py`,
the chart's values, schema and table from `tools/chart_values.py`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from annotated_types import MaxLen
from pydantic import BaseModel

from cloudrc import plugins
from cloudrc.config import problems, shipped
from cloudrc.config.overrides import KINDS
from cloudrc.config.schema import Direction, Experiment, Mission, Profile
from cloudrc.exposition import document as metrics
from cloudrc.record.topics import SAMPLING, TOPICS, Topic
from tools import chart_docs
from tools.chart_docs import ROOT, flow, insert, plain, table

PARTS = {
    "mission": "#a-mission",
    **dict.fromkeys(("uplink", "downlink"), "#one-direction-of-a-link"),
    **dict.fromkeys(KINDS, "#plug-ins-of-the-cloud"),
}
"""Keys whose own keys have a section, and its link."""

ENDS = {"world": "world", "cloud": "cloud", "either": "world and cloud"}
CLOCKS = {
    "world": "on world's clock",
    "cloud": "on cloud's clock",
    "either": "on the clock of the end that wrote the row",
}


def outputs() -> dict[Path, str]:
    """Make everything that `make docs` writes: file -> text."""
    pages = {
        **insert(ROOT / "docs" / "experiment.md", _experiment()),
        **insert(ROOT / "docs" / "topics.md", _topics()),
        ROOT / "docs" / "metrics.md": metrics.page(),
    }
    return pages | chart_docs.outputs()


def leftovers() -> list[Path]:
    """List the copies in the chart whose originals are gone."""
    return [path for path in (chart_docs.CHART / "files").glob("*/*.yaml") if path not in outputs()]


def _experiment() -> str:
    """Write the tables of all keys of an experiment, a mission and a link profile."""
    own = [key for key, info in Experiment.model_fields.items() if not _is_section(info.annotation)]
    blocks = ["\n## Top level\n", _keys(Experiment, own)]
    for key, info in Experiment.model_fields.items():
        if _is_section(info.annotation):
            blocks += [f"## `{key}`\n", _summary(info.annotation), _keys(Experiment, [key])]
    blocks += ["## Plug-ins of the cloud\n", _plug_ins()]
    blocks += ["## A mission\n", _summary(Mission), _keys(Mission)]
    blocks += ["## A link profile\n", _summary(Profile), _keys(Profile)]
    blocks += ["## One direction of a link\n", _summary(Direction), _keys(Direction)]
    blocks += ["How each key acts: [link.md](link.md).\n", "## Shipped files\n", _shipped()]
    return "\n".join(blocks)


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _summary(model: Any) -> str:
    return f"{(inspect.getdoc(model) or '').partition(chr(10) * 2)[0]}\n"


def _keys(model: type[BaseModel], chosen: list[str] | None = None) -> str:
    """Write the table of a model's keys, or of those at and below the `chosen` ones."""
    paths = []
    for leaf, _ in problems.leaves(model):
        for path in (leaf[:depth] for depth in range(1, len(leaf) + 1)):
            is_elsewhere = any(key in PARTS for key in path[:-1])
            if path[-1] != "0" and path not in paths and not is_elsewhere:
                paths.append(path)
    rows = [_row(model, path) for path in paths if chosen is None or path[0] in chosen]
    return table("key | value | unit | default | meaning", filter(None, rows))


def _row(model: type[BaseModel], path: tuple[str, ...]) -> tuple[str, ...] | None:
    info = problems.field_at(model, path)
    if info is None or not info.description:
        return None  # a section without a word of its own
    value, _, unit = problems.expectation(model, path).removeprefix("must be ").partition(" [")
    unit = unit.removesuffix("]")
    meaning = info.description.replace(f" [{unit}]", "") if unit else info.description
    key = ".".join(path).replace(".0", "[]")
    default = "required" if info.is_required() else f"`{_default(info.default)}`"
    return f"`{key}`", _value(model, path, value), unit, default, meaning


def _default(value: Any) -> str:
    return "{}" if isinstance(value, BaseModel) else flow(plain(value))


def _value(model: type[BaseModel], path: tuple[str, ...], words: str) -> str:
    """Put what an error message asks for into a cell: shorter, and with a link to its keys."""
    if words.startswith("a list of"):
        item = problems.expectation(model, (*path, "0")).partition(" [")[0]
        words += item.removeprefix("must be a number")
    for limit in getattr(problems.field_at(model, path), "metadata", ()):
        if isinstance(limit, MaxLen):
            words += f" of at most {limit.max_length}"
    words = re.sub(r">= (\S+) and <= (\S+)", r"\1 to \2", words)
    words = re.sub(r"\b(?:an?|one of) ", "", words).replace(str(2**53), "2^53")
    mapping = f"[mapping]({PARTS[path[-1]]})" if path[-1] in PARTS else "mapping"
    return re.sub(r"'(\w+)'", r"`\1`", words).replace("mapping of keys", mapping)


def _plug_ins() -> str:
    """Write the tables of the shipped plug-ins and their parameters."""
    blocks = [
        "A plug-in is a name, or a mapping with the key `name` and one key per parameter. The\n"
        "parameters of your own file are those of its function `build`: [plugins.md](plugins.md).\n"
    ]
    for key, kind in KINDS.items():
        rows: list[tuple[str, ...]] = []
        for name in _files(kind):
            rows.append((f"`{name}`", "", "", plugins.describe(kind, name)))
            texts = _arguments(plugins.find(kind, name).build)
            for parameter in plugins.signature(kind, name).parameters.values():
                default = f"`{flow(plain(parameter.default))}`"
                rows.append(("", f"`{parameter.name}`", default, texts[parameter.name]))
        blocks.append(table(f"`cloud.{key}` | parameter | default | meaning", rows))
    return "\n".join(blocks)


def _files(kind: str) -> list[str]:
    """Name the plug-ins that ship; `plugins.names` would name the installed ones, too."""
    folder = ROOT / plugins.PACKAGES[kind].replace(".", "/")
    return sorted(path.stem for path in folder.glob("[!_]*.py"))


def _arguments(function: Any) -> dict[str, str]:
    """Read the texts of the arguments from a docstring in Google style."""
    section = (inspect.getdoc(function) or "").partition("Args:\n")[2].partition("\n\n")[0]
    found = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in found}


def _shipped() -> str:
    blocks = []
    for kind in ("experiment", "mission", "profile"):
        rows = ((f"`{name}`", shipped.describe(kind, name)) for name in shipped.names(kind))
        blocks.append(table(f"{kind} | description", rows))
    for kind in ("robot", "scene"):
        blocks.append(
            f"{kind.capitalize()}s: {', '.join(f'`{n}`' for n in shipped.names(kind))}.\n"
        )
    return "\n".join(blocks)


def _topics() -> str:
    """Write the tables of all topics."""
    blocks = ["\n## All topics\n", table(*_overview())]
    for topic in TOPICS.values():
        text = re.sub(r", (world's clock|cloud's clock|clock of its end)", "", topic.text)
        blocks += [f"## `{topic.name}`\n", f"{text}.\n", _facts(topic)]
        blocks.append(table("field | type | unit | meaning", _columns(topic)))
    return "\n".join(blocks)


def _overview() -> tuple[str, Iterator[tuple[str, ...]]]:
    rows = (
        (f"[`{name}`](#{name[1:]})", f"`{topic.ros_type}`", ENDS[topic.end], SAMPLING[name][1])
        for name, topic in TOPICS.items()
    )
    return "topic | message | written by | how often", rows


def _facts(topic: Topic) -> str:
    stamp, often = SAMPLING[topic.name]
    return (
        f"- Message: `{topic.ros_type}`, written by {ENDS[topic.end]}, {often}.\n"
        f"- Stamp: {stamp}, {CLOCKS[topic.end]}.\n"
    )


def _columns(topic: Topic) -> Iterator[tuple[str, ...]]:
    for field in topic.fields:
        yield f"`{field.name}`", field.kind, field.unit, field.text


if __name__ == "__main__":
    for target, content in outputs().items():
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(content)
    for leftover in leftovers():
        leftover.unlink()
