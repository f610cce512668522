# SPDX-License-Identifier: Apache-2.0

"""Make the chart's schema and its table of values from the file `values.yaml`.

A key with a comment above it is a value or a section; the comment is its description. The type of a
value is that of its default, unless `RULES` has a schema for it. Units and other keys are those of
the models in `cloudrc/config/schema.py`.

An upgrade may bring the values of an earlier chart: it lacks keys that came later, `added`, which
are never required, and has some that have gone, files/retired.yaml, which have no effect.
"""

from __future__ import annotations

import json
import re
import tarfile
from collections.abc import Iterator
from pathlib import Path as FilePath
from typing import Any, TypeAlias

import yaml
from pydantic import TypeAdapter
from pydantic.json_schema import models_json_schema

from cloudrc.config.profile import Profile
from cloudrc.config.schema import Experiment, MissionConfig, RosNamespace

Schema: TypeAlias = dict[str, Any]
Path: TypeAlias = tuple[str, ...]


def _either(*parts: Schema) -> Schema:
    return {"anyOf": [*parts]}


def _text(pattern: str) -> Schema:
    return {"type": "string", "pattern": pattern}


def _one_of(*names: str) -> Schema:
    return {"type": "string", "enum": [*names]}


def _ref(name: str) -> Schema:
    return {"$ref": f"#/$defs/{name}"}


ROOT = FilePath(__file__).resolve().parents[1]
RETIRED = ROOT / "charts" / "cloudrc" / "files" / "retired.yaml"
EARLIEST = ROOT / "tests" / "fixtures" / "charts" / "cloudrc-before-guests.tgz"
"""The earliest chart that can be upgraded."""
NULL, OBJECT, STRING = {"type": "null"}, {"type": "object"}, {"type": "string"}
TEXTS = {**OBJECT, "additionalProperties": STRING}
NAME = _text(r"^$|^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$")
NUMBER = {"type": "number", "minimum": 0}
QUANTITY = _either(_text(r"^[0-9]+(\.[0-9]+)?(m|k|Ki|M|Mi|G|Gi|T|Ti)?$"), NUMBER)
PEERS = {
    "type": "array",
    "items": {
        **OBJECT,
        "description": "A peer of a NetworkPolicy; with both selectors, a pod must match both",
        "propertyNames": {"enum": ["podSelector", "namespaceSelector", "ipBlock"]},
        "additionalProperties": OBJECT,
    },
}
LABELS = {**TEXTS, "propertyNames": {"not": {"pattern": r"^app\.kubernetes\.io/"}}}
OBJECTS = {"type": "array", "items": OBJECT}
NAMED = {**OBJECT, "required": ["name"]}
SECRET = {**OBJECT, "properties": {"name": NAME}, "additionalProperties": False}
PULL_SECRETS = {"type": "array", "items": _either(STRING, {**SECRET, "required": ["name"]})}
HOST = _text(r"^$|^([a-z0-9]([-a-z0-9]*[a-z0-9])?\.)*[a-z0-9]([-a-z0-9]*[a-z0-9])?$")
PORT = {"type": "integer", "minimum": 1, "maximum": 65_535}
NAMES = (
    "queueName",
    "schedulerName",
    "configMap",
    "priorityClassName",
    "runtimeClassName",
    "existingClaim",
    "tlsSecret",
    "className",
    "existingSecret",
    "name",
)
"""Values that are names of Kubernetes."""
RULES = {
    **dict.fromkeys(NAMES, NAME),
    "fullnameOverride": _text(r"^$|^[a-z]([-a-z0-9]*[a-z0-9])?$"),
    "tag": _text(r"^$|^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$"),
    "digest": _text(r"^$|^sha256:[0-9a-f]{64}$"),
    "pullPolicy": _one_of("Always", "IfNotPresent", "Never"),
    "experiment": _ref("Experiment"),
    "robots": _either({"type": "integer", "minimum": 1, "maximum": 1000}, NULL),
    "mode": _one_of("auto", "netem", "relay"),
    "profile": _either(STRING, _ref("Profile"), NULL),
    "traces": {
        **TEXTS,
        # Names of other files in the same folder are refused.
        "propertyNames": {
            **_text(r"^[-._a-zA-Z0-9]+$"),
            "not": {"enum": ["profile.yaml", "change.json", "experiment.yaml"]},
        },
    },
    "resources": _ref("Resources"),
    "tolerations": OBJECTS,
    "topologySpreadConstraints": OBJECTS,
    "extraObjects": {"type": "array", "items": _either(OBJECT, STRING)},
    "affinity": OBJECT,
    "commonLabels": LABELS,
    "podLabels": LABELS,
    "extraEnv": {"type": "array", "items": NAMED},
    "extraVolumes": {"type": "array", "items": NAMED},
    "extraVolumeMounts": {"type": "array", "items": {**OBJECT, "required": ["name", "mountPath"]}},
    "recordingSizeLimit": QUANTITY,
    "workers": {"type": "integer", "minimum": 1, "maximum": 64},
    "storage": _either(*QUANTITY["anyOf"], _one_of("")),
    "accessMode": _one_of("ReadWriteOnce", "ReadWriteOncePod", "ReadWriteMany"),
    "memory": QUANTITY,
    "keepMissions": {"type": "integer", "minimum": 1},
    "keepDays": {"type": "number", "exclusiveMinimum": 0},
    "apiHost": HOST,
    "consoleHost": HOST,
    "parentRefs": {"type": "array", "items": NAMED},
    "pullSecrets": PULL_SECRETS,
    "schedule": _text(r"^$|^(@[a-z]+|[-*,/0-9A-Za-z]+( [-*,/0-9A-Za-z?#]+){4})$"),
    "size": QUANTITY,
    "type": _one_of("ClusterIP", "NodePort", "LoadBalancer"),
    "port": PORT,
    "dnsPort": PORT,
    "leaseSeconds": {"type": "integer", "minimum": 5, "maximum": 3600},
    "allowFrom": PEERS,
    "dns": PEERS,
    "runbooks": _text("^$|^https?://"),
    "plan": _either(STRING, _ref("MissionConfig"), NULL),
    "interval": _text(r"^[0-9]+(ms|s|m)$"),
    "namespace": TypeAdapter(RosNamespace).json_schema(),
    "ipFamilyPolicy": _either(_one_of("SingleStack", "PreferDualStack", "RequireDualStack"), NULL),
    "podSecurityContext": _either(OBJECT, NULL),
    "containerSecurityContext": _either(OBJECT, NULL),
}
"""Last part of a key -> schema of its value, if the type of the default is not enough."""
TYPES: dict[type, Schema] = {
    bool: {"type": "boolean"},
    int: {"type": "integer", "minimum": 0},
    str: STRING,
    list: {"type": "array", "items": STRING},
    dict: TEXTS,
}
"""Type of a default -> schema of the value."""


def _closed(description: str, properties: Schema) -> Schema:
    rest = {"properties": properties, "additionalProperties": False}
    return {**OBJECT, "description": description, **rest}


def descriptions(text: str) -> dict[Path, str]:
    """Read the comment above each key of `values.yaml`: path of the key -> description."""
    found: dict[Path, str] = {}
    path, words = list[str](), list[str]()
    for line in text.splitlines():
        if comment := re.match(r" *# (.*)", line):
            words.append(comment[1])
        elif not line:  # what is above belongs to no key
            words = []
        elif key := re.match(r"((?:  )*)(\w+):", line):
            path = [*path[: len(key[1]) // 2], key[2]]
            if words:
                found[tuple(path)] = " ".join(words)
            words = []
    return found


def table_rows(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield key, default and description of each value."""
    described, values = descriptions(text), yaml.safe_load(text)
    for path, about in described.items():
        if not any(other[:-1] == path for other in described):
            default = values
            for key in path:
                default = default[key]
            yield f"`{'.'.join(path)}`", f"`{json.dumps(default)}`", about


def earliest() -> dict[str, Any]:
    """Return the default values of the earliest chart that can be upgraded."""
    with tarfile.open(EARLIEST) as chart:
        file = chart.extractfile("cloudrc/values.yaml")
        assert file is not None
        return dict(yaml.safe_load(file))


def added(values: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """Return the part of the default `values` whose keys a chart with the values `before` lacks."""
    found = {}
    for key, value in values.items():
        if key not in before:
            found[key] = value
        elif isinstance(value, dict) and isinstance(before[key], dict):
            if inner := added(value, before[key]):
                found[key] = inner
    return found


def make_schema(text: str) -> Schema:
    """Make the JSON schema of the values: draft 7, unknown keys are not allowed."""
    described, values = descriptions(text), yaml.safe_load(text)

    def part(path: Path, value: Any, about: str, new: Any) -> Schema:
        """Make the schema of a value, of which `new` are the keys that earlier charts lack."""
        if not any(other[:-1] == path for other in described):
            return {"description": about, **(RULES.get(path[-1]) or TYPES[type(value)])}
        parts = {
            key: part((*path, key), each, described[*path, key], new.get(key, {}))
            for key, each in value.items()
        }
        # Templates need the sections, so null is refused for them.
        needed = [
            key
            for key, each in parts.items()
            if ("$ref" in each or "properties" in each) and new.get(key) != value[key]
        ]
        return {**_closed(about, parts), "required": needed}

    made = part((), values, "All values of the chart", added(values, earliest()))
    about = "Values that Helm passes to all charts of a larger chart"
    shared = {"imageRegistry": _either(STRING, NULL), "imagePullSecrets": PULL_SECRETS}
    some = {**OBJECT, "properties": shared}
    made["properties"]["global"] = {**_either(some, NULL), "description": about}
    about = "A larger chart's condition for this one: if it is false, Helm leaves this one out"
    made["properties"]["enabled"] = {"enum": [True], "description": about}
    models = [(model, "validation") for model in (Experiment, MissionConfig, Profile)]
    defined = _adapt(models_json_schema(models)[1]["$defs"])
    vary = defined["FleetConfig"]["properties"]["vary"]
    for owner in (defined["PlugIn"], defined["Parameters"], vary["items"]):
        owner["additionalProperties"] = {
            "description": "A parameter of the plug-in, in the unit that its `build` documents",
            "type": ["number", "string", "boolean", "array", "null"],
        }
    amount = _either(*QUANTITY["anyOf"], NULL)
    about = "CPU [cores; 250m is a quarter of a core] and memory [bytes; 64Mi is 64 * 2^20]"
    amounts = _closed(about, {"cpu": amount, "memory": amount})
    about = "Requests and limits of one container; if all are equal, the QoS class is Guaranteed"
    defined["Resources"] = _closed(about, {"requests": amounts, "limits": amounts})
    for path, instead in yaml.safe_load(RETIRED.read_text()).items():
        *sections, key = path.split(".")
        node = made
        for section in sections:
            node = node["properties"][section]
            node = defined[node["$ref"].rpartition("/")[2]] if "$ref" in node else node
        node["properties"][key] = {"description": f"Has no effect; {instead} takes its place"}
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "cloudrc"}
    return {**head, **made, "$defs": defined}


def _adapt(part: Any) -> Any:
    """Convert tuples of fixed length to draft 7, and leave out titles and defaults."""
    if isinstance(part, list):
        return [_adapt(item) for item in part]
    if not isinstance(part, dict):
        return part
    kept = {key: _adapt(each) for key, each in part.items() if key not in ("title", "default")}
    if "prefixItems" in kept:  # a vector: all items have one schema
        kept["items"] = kept.pop("prefixItems")[0]
    return kept
