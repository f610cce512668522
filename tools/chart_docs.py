"""Write values.yaml, values.schema.json and the tables of the chart's README (`make chart-docs`).

They come from the models in `chart_values.py`. Shipped profiles and missions are copied, because a
chart can read only its own files.
"""

from __future__ import annotations

import json
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]

import chart_values  # noqa: E402
from chart_kubernetes import Quantities, Resources  # noqa: E402
from chart_values import ChartValues  # noqa: E402

from cloudrc.config.problems import leaves  # noqa: E402
from cloudrc.config.schema import Experiment  # noqa: E402
from cloudrc.config.shipped import FOLDERS  # noqa: E402

CHART = ROOT / "charts" / "cloudrc"
HEAD = "# Written by `make chart-docs` from tools/chart_values.py: edit that file.\n"
COPIED = {"profiles": FOLDERS["profile"], "missions": FOLDERS["mission"]}
WIDTH = 96
COMPACT = (Resources, Quantities)


def outputs() -> dict[Path, str]:
    """Generate all files: path -> text."""
    found = {
        CHART / "values.yaml": HEAD + values_text(ChartValues()),
        CHART / "values.schema.json": json.dumps(schema(), indent=2) + "\n",
        CHART / "README.md": readme((CHART / "README.md").read_text()),
    }
    for folder, source in COPIED.items():
        for path in sorted(source.glob("*.yaml")):
            found[CHART / "files" / folder / path.name] = path.read_text()
    return found


def stale() -> list[Path]:
    """List the files that differ from `outputs`, and copies whose original is gone."""
    wanted = outputs()
    old = [path for path, text in wanted.items() if not path.exists() or path.read_text() != text]
    return old + [path for path in (CHART / "files").glob("*/*.yaml") if path not in wanted]


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
            lines += [f"{key}:", *(f"  {k}: {_flow(v)}" for k, v in _plain(value).items())]
        else:
            lines.append(f"{key}: {_flow(_plain(value))}")
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


def readme(text: str) -> str:
    """Insert the tables between their marks."""
    tables = {"values": _table(_rows(ChartValues())), "experiment": _table(_experiment_rows())}
    for name, table in tables.items():
        head, mark, rest = text.partition(f"<!-- {name}: make chart-docs -->\n")
        _, end, tail = rest.partition("<!-- end -->")
        if not end:
            raise ValueError(f"README.md: no place for the table '{name}'")
        text = f"{head}{mark}{table}{end}{tail}"
    return text


def _rows(part: BaseModel, above: str = "") -> Iterator[tuple[str, str, str]]:
    for name, info in type(part).model_fields.items():
        value, key = getattr(part, name), f"{above}{info.alias or name}"
        if isinstance(value, BaseModel) and not isinstance(value, (*COMPACT, Experiment)):
            yield from _rows(value, f"{key}.")
        else:
            shown = {} if isinstance(value, Experiment) else _plain(value)
            yield key, json.dumps(shown), info.description or ""


def _experiment_rows() -> Iterator[tuple[str, str, str]]:
    for path, info in leaves(Experiment):
        key = ".".join(path).replace(".0", "[]")
        default = None if info.is_required() else info.default
        yield key, "" if info.is_required() else json.dumps(_plain(default)), info.description or ""


def _table(rows: Iterator[tuple[str, str, str]]) -> str:
    lines = ["| key | default | meaning |", "|---|---|---|"]
    for key, default, meaning in rows:
        cells = (f"`{key}`", f"`{default}`" if default else "required", meaning)
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines) + "\n"


def _plain(value: Any) -> Any:
    """Convert a default to plain YAML values."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", by_alias=True, exclude_none=True)
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value


def _flow(value: Any) -> str:
    """Format a value as YAML on one line."""
    if isinstance(value, dict):
        inner = ", ".join(f"{key}: {_flow(item)}" for key, item in value.items())
        return f"{{{inner}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z][\w./-]*|[0-9]+[A-Za-z]+", value):
        return value
    return json.dumps(value)


if __name__ == "__main__":
    for target, content in outputs().items():
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(content)
    for leftover in stale():
        leftover.unlink()
