"""Generate values.yaml, values.schema.json and the table of the chart's README (`make docs`).

They come from the models in `chart_values.py`. Shipped profiles and missions are copied, because a
chart can read only its own files.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cloudrc.config.schema import Experiment
from cloudrc.config.shipped import FOLDERS
from tools import chart_values
from tools.chart_kubernetes import Quantities, Resources
from tools.chart_values import ChartValues

ROOT = Path(__file__).resolve().parents[1]
CHART = ROOT / "charts" / "cloudrc"
HEAD = "# Written by `make docs` from tools/chart_values.py: edit that file.\n"
COPIED = {"profiles": FOLDERS["profile"], "missions": FOLDERS["mission"]}
WIDTH = 96
COMPACT = (Resources, Quantities)


def outputs() -> dict[Path, str]:
    """Generate all files: path -> text."""
    found = {
        CHART / "values.yaml": HEAD + values_text(ChartValues()),
        CHART / "values.schema.json": json.dumps(schema(), indent=2) + "\n",
        **insert(CHART / "README.md", table("key | default | meaning", _values(ChartValues()))),
    }
    for folder, source in COPIED.items():
        for path in sorted(source.glob("*.yaml")):
            found[CHART / "files" / folder / path.name] = path.read_text()
    return found


def values_text(part: BaseModel, depth: int = 0) -> str:
    """Format a part of the values as YAML, each key below its description."""
    lines = []
    for name, info in type(part).model_fields.items():
        value, key = getattr(part, name), info.alias or name
        if key == "global":
            continue
        lines += [f"# {line}" for line in textwrap.wrap(info.description or "", WIDTH - 2 * depth)]
        if isinstance(value, Experiment):
            lines.append(f"{key}: {{}}")
        elif isinstance(value, BaseModel) and not isinstance(value, COMPACT):
            lines += [f"{key}:", values_text(value, depth + 1).rstrip("\n")]
        elif isinstance(value, Resources):
            lines += [f"{key}:", *(f"  {k}: {flow(v)}" for k, v in plain(value).items())]
        else:
            lines.append(f"{key}: {flow(plain(value))}")
        if depth == 0:
            lines.append("")
    return textwrap.indent("\n".join(lines).rstrip("\n"), "  " if depth else "") + "\n"


def schema() -> dict[str, Any]:
    """Generate the JSON schema of the values, in draft 7, without unknown keys at any level."""
    made = ChartValues.model_json_schema(by_alias=True)
    made = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "cloudrc", **made}
    made["$defs"] = {name: _adapt(part) for name, part in made.pop("$defs").items()}
    own = [name for name in made["$defs"] if _is_own(name)]
    for part in (made, *(made["$defs"][name] for name in own)):
        part["required"] = sorted({*part.get("required", ()), *_subparts(part)})
    plug_in = made["$defs"]["PlugIn"]
    plug_in["additionalProperties"] = {
        "description": "A parameter of the plug-in, in the unit that its `build` documents",
        "type": ["number", "string", "boolean", "array", "null"],
    }
    return dict(_adapt(made))


def _is_own(name: str) -> bool:
    """Whether a definition is from `chart_values`, not from Kubernetes or the experiment."""
    kind = getattr(chart_values, name, None)
    return getattr(kind, "__module__", "") == chart_values.__name__


def _subparts(part: dict[str, Any]) -> list[str]:
    """List the keys that templates need as mappings: the schema then refuses null for them."""
    return [key for key, value in part["properties"].items() if "$ref" in value]


def _adapt(part: Any) -> Any:
    """Remove pydantic's titles and defaults; convert fixed tuples to draft 7."""
    if isinstance(part, list):
        return [_adapt(item) for item in part]
    if not isinstance(part, dict):
        return part
    kept = {
        key: {name: _adapt(inner) for name, inner in value.items()}
        if key == "properties"
        else _adapt(value)
        for key, value in part.items()
        if key != "default" and not (key == "title" and value != "cloudrc")
    }
    if "prefixItems" in kept:  # a vector: all items have one type
        kept["items"] = kept.pop("prefixItems")[0]
    return kept


def insert(page: Path, text: str) -> dict[Path, str]:
    """Put generated text between the marks of a page; the rest is written by hand."""
    parts = re.split("(<!-- made by `make docs`.*-->\n|<!-- end -->\n)", page.read_text())
    if len(parts) != 5:
        raise ValueError(f"{page.name}: no place for generated text")
    parts[2] = text
    return {page: "".join(parts)}


def _values(part: BaseModel, above: str = "") -> Iterator[tuple[str, str, str]]:
    for name, info in type(part).model_fields.items():
        value, key = getattr(part, name), f"{above}{info.alias or name}"
        if isinstance(value, BaseModel) and not isinstance(value, (*COMPACT, Experiment)):
            yield from _values(value, f"{key}.")
        else:
            shown = {} if isinstance(value, Experiment) else plain(value)
            yield f"`{key}`", f"`{json.dumps(shown)}`", info.description or ""


def table(columns: str, rows: Iterable[Iterable[object]]) -> str:
    """Write a table in Markdown; `columns` are their heads, with bars between them."""
    lines = [f"| {columns} |", f"|{'---|' * len(columns.split('|'))}"]
    for row in rows:
        lines.append(f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in row)} |")
    return "\n".join(lines) + "\n"


def plain(value: Any) -> Any:
    """Convert a default to plain YAML values."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", by_alias=True, exclude_none=True)
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def flow(value: Any) -> str:
    """Format a value as YAML on one line."""
    if isinstance(value, dict):
        inner = ", ".join(f"{key}: {flow(item)}" for key, item in value.items())
        return f"{{{inner}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(flow, value))}]"
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z][\w./-]*|[0-9]+[A-Za-z]+", value):
        return value
    return json.dumps(value)
