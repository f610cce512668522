# SPDX-License-Identifier: Apache-2.0

"""Write all generated files. `make docs` runs this module; a test compares the files.

The tables of docs/experiment.md come from the models in `cloudrc/config/schema.py` and from the
signatures of the shipped plug-ins. The tables of docs/topics.md come from
`cloudrc/results/record/topics.py`, those of docs/metrics.md from
`cloudrc/results/exposition/table.py`. The text around the tables is written by hand. `QUANTITIES`
gives panels to the dashboard of missions. The table of docs/on-call.md comes from the chart's
`files/rules.yaml`, those of docs/reference/faults.md from the marks of the tests that inject
faults. The menu of the site is the list of pages in docs/README.md.

Each shipped robot and mission has a page of its own (`tools/guests.py`).

The chart's schema and table come from its `values.yaml`. Shipped profiles and missions are copied,
because a chart can read only its own files.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from cloudrc.base import plugins
from cloudrc.base.outside.values import to_plain
from cloudrc.config import shipped
from cloudrc.config.keys import forms, keys_of, unit_in
from cloudrc.config.overrides import KINDS, default_parameters
from cloudrc.config.profile import DirectionConfig, Profile
from cloudrc.config.robot import find_robot
from cloudrc.config.schema import Experiment, MissionConfig
from cloudrc.results.exposition.table import METRICS, ROLES
from cloudrc.results.metrics.definitions import QUANTITIES, RecordQuantity
from cloudrc.results.record.topics import TOPICS
from tools import faults, metadata, ranking, wings
from tools.chart_values import added, earliest, make_schema, table_rows
from tools.dashboards import UNITS
from tools.guests import OWN_FLIGHTS, link, pages
from tools.markdown import table
from tools.site import contents, site_name

ROOT = Path(__file__).resolve().parents[1]
CHART = ROOT / "charts" / "cloudrc"
PARTS = {
    "mission": "#a-mission",
    "onboard": "#onboard-controllers",
    **dict.fromkeys(("uplink", "downlink"), "#one-direction-of-a-link"),
    **dict.fromkeys(KINDS, "#plug-ins-of-the-cloud"),
}
"""Key of an experiment that has its own section on the page -> link to the section."""
ENDS = {"world": "world", "cloud": "cloud", "either": "world and cloud"}
_PERIOD = "once per command (100 Hz by default), while there is telemetry and a setpoint"
_LINK = "once per change; again when a session, a mission or a state of the guard begins"
_STAMPS = {
    ("instant at which world measures the state and sends the telemetry",
     "100 Hz by default, in a session"):
        "/odometry /telemetry",
    ("instant of the physics step", "100 Hz, or the rate of the odometry if it is higher"):
        "/ground_truth /contact_force /sensor /reference /target /target_view",
    ("instant of the physics step", "1 Hz, and once per row of /guard"): "/energy",
    ("arrival at cloud", "once per telemetry that arrives"): "/uplink_delay",
    ("arrival at world", "once per command that arrives"): "/downlink_delay",
    ("first physics step that follows the command", "once per command applied"): "/command_applied",
    ("physics step in which the state changes", "once per event"): "/guard",
    ("stamp of the first row of `/ground_truth` after the contact", "once per event"):
        "/contact",
    ("instant at which this session begins in world or in cloud", "once per event"): "/session",
    ("departure of the command", _PERIOD):
        "/estimated_odometry /setpoint_position /cmd_vel /delay_estimate /pid",
    ("physics step at which the scan is taken", "`rate_hz` of the scanner, in a session"): "/scan",
    ("first command from the perception's setpoint; without one, when that is known",
     "once per scan or picture that the perception has looked at"): "/perception",
    ("when world sends the picture", "`fps` of the camera, in a session"): "/frame",
    ("when cloud has the picture and all that it needs", "once per picture that cloud shows"):
        "/frame_shown /camera",
    ("arrival of the telemetry at cloud", "once per telemetry while the robot follows a plan"):
        "/plan",
    ("departure of the command", "once per command whose computation takes simulated time"):
        "/left",
    ("when the datagram has left the cell",
     "once per command and telemetry in a cell, in virtual time"):
        "/cell_wait",
    ("departure of the datagram",
     "once per command and telemetry, in virtual time, if the link has a rate or a radio"):
        "/link_wait",
    ("instant of the event", "once per event"): "/mission",
    ("when world or cloud notices the fault", "once per fault; repetitions are counted"): "/fault",
    ("when the counters are read", "1 Hz per counter; counters of a relay 0.5 Hz"): "/count",
    ("when world or cloud notices that the link has changed", _LINK): "/link",
    ("end of the interval that is judged", "every 5 s per quantity"): "/link_check",
    ("instant at which the loop wakes and begins the period",
     "once per wake, 100 Hz per end by default"):
        "/lateness",
}  # fmt: skip
SAMPLING = {name: about for about, names in _STAMPS.items() for name in names.split()}
"""Topic -> meaning of a row's stamp, and when a row is written."""
OPEN = {
    "version": "the version",
    "config": "the first 12 digits of the SHA-256 of the process's configuration with all "
    "defaults. On one machine this includes the defaults of plug-ins, as `config_sha256` in "
    "report.json; in a cluster it does not",
    "sensor": "the name in `robot.yaml`",
    "unit": "the unit in `robot.yaml`",
    "body": "the name of the body in the scene",
    "robot": "the number of the robot in its fleet",
}
"""Label of a metric that has too many values for a list -> description of the values."""
GRAFANA = {symbol: name for name, symbol in UNITS.items()}
"""Symbol of a unit -> its name in Grafana."""
TYPES = {
    "number": "number",
    "integer": "whole number",
    "string": "text",
    "null": "null",
    "boolean": "true or false",
    "array": "list",
    "object": "mapping",
}
"""Type in a JSON schema -> the page's word."""
LIMITS = {
    "minimum": ">=",
    "exclusiveMinimum": ">",
    "maximum": "<=",
    "exclusiveMaximum": "<",
    "maxItems": "of at most",
}
"""Limit in a JSON schema -> the page's sign."""
ADDED = """\
# Made by `make docs`: values that the earliest chart lacks that can be upgraded, with defaults.
"""
COPIED = ("profile", "mission")
"""Kinds of shipped files of which the chart has copies."""


def outputs() -> dict[Path, str]:
    """Generate everything that `make docs` writes: file -> text."""
    values = (CHART / "values.yaml").read_text()
    rows = table("key | default | meaning", table_rows(values))
    new = added(yaml.safe_load(values), earliest())
    return {
        **metadata.outputs(),
        **insert(ROOT / "docs" / "experiment.md", _experiment()),
        **insert(ROOT / "docs" / "topics.md", _topics()),
        **insert(ROOT / "docs" / "metrics.md", _metrics()),
        **insert(ROOT / "docs" / "on-call.md", f"\n{_alerts()}"),
        **insert(ROOT / "docs" / "reference" / "faults.md", _faults()),
        **pages(),
        **insert(ROOT / "docs" / "architecture.md", f"\n{wings.listed()}\n"),
        wings.PICTURE: wings.picture(),
        **ranking.outputs(),
        **insert(CHART / "README.md", f"\n{rows}"),
        **insert(ROOT / "mkdocs.yml", f"{_navigation()}# "),
        **insert(CHART / "files" / "dashboards" / "missions.yaml", f"{panels(QUANTITIES)}# "),
        CHART / "values.schema.json": json.dumps(make_schema(values), indent=2) + "\n",
        CHART / "files" / "added.yaml": ADDED + yaml.safe_dump(new, sort_keys=False),
        **{
            CHART / "files" / f"{kind}s" / path.name: path.read_text()
            for kind in COPIED
            for path in sorted(shipped.FOLDERS[kind].glob("*.yaml"))
        },
    }


def leftovers(made: dict[Path, str]) -> list[Path]:
    """List copies in the chart whose original has been deleted; `made` are the generated files."""
    copies = {path for kind in COPIED for path in (CHART / "files" / f"{kind}s").glob("*.yaml")}
    return sorted(copies - made.keys())


def insert(page: Path, text: str) -> dict[Path, str]:
    """Replace the text between the marks of a page by generated text."""
    parts = re.split("(<!-- made by `make .*-->\n|<!-- end -->\n)", page.read_text("utf-8"))
    if len(parts) != 5:
        raise ValueError(f"{page.name}: needs one pair of marks around the generated text")
    parts[2] = text
    return {page: "".join(parts)}


def flow(value: Any) -> str:
    """Format a default value as YAML on one line."""
    text = yaml.safe_dump(to_plain(value), default_flow_style=True, sort_keys=False, width=10**6)
    return text.removesuffix("...\n").strip()


def _experiment() -> str:
    own = [key for key, info in Experiment.model_fields.items() if not _is_section(info.annotation)]
    blocks = ["\n## Top level\n", _keys(Experiment, own)]
    for key, info in Experiment.model_fields.items():
        if _is_section(info.annotation):
            blocks += [f"## `{key}`\n", _summary(info.annotation), _keys(Experiment, [key])]
    blocks += ["## Onboard controllers\n", _onboard()]
    blocks += ["## Plug-ins of the cloud\n", _plug_ins()]
    blocks += ["## A mission\n", _summary(MissionConfig), _keys(MissionConfig)]
    blocks += ["## A link profile\n", _summary(Profile), _keys(Profile)]
    blocks += ["## One direction of a link\n", _summary(DirectionConfig), _keys(DirectionConfig)]
    blocks += ["How each key acts: [link.md](link.md).\n", "## Shipped files\n", _shipped()]
    return "\n".join(blocks)


def _alerts() -> str:
    """Format the table of alerts; the first sentence of a description is the first action."""
    groups = yaml.safe_load((CHART / "files" / "rules.yaml").read_text())["groups"]
    rows: list[tuple[str, ...]] = []
    for rule in (rule for group in groups for rule in group["rules"] if "alert" in rule):
        name, told = rule["alert"], rule["annotations"]
        texts = told["summary"].rstrip("."), told["description"].partition(". ")[0].rstrip(".")
        commands = (re.sub(r"(?<=[ (])'([^']+)'", r"`\1`", text) for text in texts)
        rows.append((f"[{name}](#{name.lower()})", *commands))
    return table("alert | meaning | first action", rows)


def _faults() -> str:
    others = "These need real processes, a disk or a cluster:"
    return (
        f"\n### In virtual time\n\n{faults.named()}\n### Elsewhere\n\n{others}\n\n{faults.others()}"
    )


def panels(quantities: Iterable[RecordQuantity]) -> str:
    """Format the panels of the dashboard that quantities have."""
    texts = []
    for each in quantities:
        if each.panel:
            legend = "{{axis}}" if "[axis]" in each.live else "value"
            query = each.live.partition("[")[0] + "{$pods}"
            panel = {"title": each.panel, "unit": GRAFANA.get(each.unit, "short")}
            panel |= {"queries": {legend: query}}
            text = yaml.safe_dump([panel], sort_keys=False, width=100)
            texts.append(re.sub("^", "  ", text, flags=re.MULTILINE).rstrip(" "))
    return "".join(texts)


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _summary(model: Any) -> str:
    return f"{(inspect.getdoc(model) or '').partition(chr(10) * 2)[0]}\n"


def _keys(model: type[BaseModel], chosen: list[str] | None = None) -> str:
    """Format the table of a model's keys; with `chosen`, only these keys and those below them."""
    defined = model.model_json_schema()
    paths = keys_of(defined, defined, apart=PARTS)
    rows = [
        _row(path, part, defined)
        for path, part in paths
        if not chosen or path[0].removesuffix("[]") in chosen
    ]
    return table("key | value | unit | default | meaning", rows)


def _row(path: tuple[str, ...], part: Any, defined: Any) -> tuple[str, ...]:
    words = dict.fromkeys(_words(each) for each in forms(defined, part))
    value, meaning = " or ".join(words), " ".join(part["description"].split())
    if path[-1] in PARTS:
        value = value.replace("mapping", f"[mapping]({PARTS[path[-1]]})")
    unit = unit_in(part)
    meaning = meaning.replace(f" {unit}", "") if unit else meaning
    default = "required"
    if "default" in part:
        default = f"`{'{}' if isinstance(part['default'], dict) else flow(part['default'])}`"
    return f"`{'.'.join(path)}`", value, unit[1:-1], default, meaning


def _words(form: Any) -> str:
    """Say which values a JSON schema without choices allows."""
    if "enum" in form:
        return ", ".join(f"`{each}`" for each in form["enum"])
    kind, size = form["type"], len(form.get("prefixItems", ()))
    if size:
        inner = _words(form["prefixItems"][0])
        return f"list of {size} " + re.sub("number|list", r"\g<0>s", inner, count=1)
    limits = {LIMITS[key]: form[key] for key in LIMITS if key in form}
    text = " and ".join(f"{sign} {limit:.16g}" for sign, limit in limits.items())
    text = re.sub(r">= (\S+) and <= (\S+)", r"\1 to \2", text)
    text += " (1 % is 0.01)" * (text == "0 to 1")
    return f"{TYPES[kind]} {text}".strip()


def _plug_ins() -> str:
    blocks = [
        "A plug-in is a name, or a mapping with the key `name` and one key per parameter. The\n"
        "parameters of your own file are those of its function `build`: [plugins.md](plugins.md).\n"
    ]
    for key, kind in KINDS.items():
        rows: list[tuple[str, ...]] = []
        for name in _files(kind):
            rows.append((f"`{name}`", "", "", plugins.describe(kind, name)))
            rows += _parameters(kind, name)
        blocks.append(table(f"`cloud.{key}` | parameter | default | meaning", rows))
    return "\n".join(blocks)


def _parameters(kind: str, name: str) -> list[tuple[str, ...]]:
    """Return a row for each parameter of a plug-in; the first cell is empty."""
    texts = _arguments(plugins.builder(kind, name))
    rows: list[tuple[str, ...]] = [
        ("", f"`{parameter}`", f"`{flow(default)}`", texts[parameter])
        for parameter, default in default_parameters(kind, name).items()
    ]
    return [*rows, *(("", "others", "", texts[each]) for each in texts if each.startswith("*"))]


def _onboard() -> str:
    """Format the table of the parameters of the shipped robots' onboard controllers."""
    robots: dict[str, list[str]] = {}
    for robot in shipped.names("robot"):
        controller = find_robot(robot).onboard
        assert controller is not None
        robots.setdefault(controller.name, []).append(f"`{robot}`")
    rows: list[tuple[str, ...]] = []
    for name, those in robots.items():
        about = plugins.describe("onboard", name)
        rows.append((", ".join(those), "", "", about))
        rows += _parameters("onboard", name)
    return table("`world.robot` | parameter of `world.onboard` | default | meaning", rows)


def _files(kind: str) -> list[str]:
    """Name the shipped plug-ins of a kind; `plugins.names` would include installed plug-ins."""
    folder = ROOT / plugins.PACKAGES[kind].replace(".", "/")
    return sorted(path.stem for path in folder.glob("[!_]*.py"))


def _arguments(function: Any) -> dict[str, str]:
    """Read the descriptions of arguments from a docstring in Google style."""
    section = (inspect.getdoc(function) or "").partition("Args:\n")[2].partition("\n\n")[0]
    found = re.findall(r"^    (\**\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in found}


def _shipped() -> str:
    blocks = []
    for kind in ("experiment", "mission", "robot", "profile"):
        rows = ((_name(kind, name), shipped.describe(kind, name)) for name in shipped.names(kind))
        blocks.append(table(f"{kind} | description", rows))
    blocks.append(f"Scenes: {', '.join(f'`{each}`' for each in shipped.names('scene'))}.\n")
    return "\n".join(blocks)


def _name(kind: str, name: str) -> str:
    """Return a shipped file's name, with a link if it has a page."""
    return link(kind, name) if kind in OWN_FLIGHTS else f"`{name}`"


def _navigation() -> str:
    """Format the menu of the site: the headings of docs/README.md, with their pages."""
    lines = ["nav:"]
    for number, (head, rows) in enumerate(contents().items()):
        first = [] if number else ["index.md", "All pages: pages.md"]
        names = [*first, *(site_name(source) for source, _ in rows)]
        lines += [f"  - {head}:", *(f"      - {name}" for name in names)]
    return "\n".join(lines) + "\n"


def _topics() -> str:
    overview = (
        (f"[`{name}`](#{name[1:]})", f"`{topic.ros_type}`", ENDS[topic.end], SAMPLING[name][1])
        for name, topic in TOPICS.items()
    )
    blocks = ["\n## All topics\n", table("topic | message | written by | how often", overview)]
    for name, topic in TOPICS.items():
        text = re.sub(r", (world's clock|cloud's clock|clock of its end)", "", topic.text)
        stamp, _ = SAMPLING[name]
        clock = f"{topic.end}'s clock"
        if topic.end == "either":
            clock = "the clock of the process that writes the row"
        blocks += [
            f"## `{name}`\n",
            f"{text}.\n",
            f"Stamp, on {clock}: {stamp}.\n",
            table(
                "field | type | unit | meaning",
                ((f"`{field.name}`", field.kind, field.unit, field.text) for field in topic.fields),
            ),
        ]
    return "\n".join(blocks)


def _metrics() -> str:
    rows = []
    for metric in METRICS.values():
        labels = [
            f"`{key}`: {', '.join(known) or OPEN[key]}" for key, known in metric.labels.items()
        ]
        meaning = metric.meaning + (f" Labels: {'; '.join(labels)}." if labels else "")
        roles = "all" if metric.roles == ROLES else ", ".join(metric.roles)
        rows.append((f"`{metric.name}`", metric.kind.value, roles, meaning))
    buckets = [
        f"- `{metric.name}`: {', '.join(f'{bound:g}' for bound in metric.buckets)}\n"
        for metric in METRICS.values()
        if metric.buckets
    ]
    head = "## Buckets\n\nUpper bounds of the buckets of each histogram [s]:\n\n"
    return f"\n{table('metric | type | from | meaning', rows)}\n{head}{''.join(buckets)}"


if __name__ == "__main__":
    generated = outputs()
    for target, content in generated.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(content)
    for leftover in leftovers(generated):
        leftover.unlink()
