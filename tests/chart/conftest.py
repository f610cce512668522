"""Render the chart without helm.

gotpl is the template engine. As in helm, values are merged with the defaults and checked against
the schema. A cluster is a function that answers `lookup`.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from gotpl.exts import helm as gotpl_helm

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "charts" / "cloudrc"
METADATA = yaml.safe_load((CHART / "Chart.yaml").read_text())
CI_VALUES = sorted((CHART / "ci").glob("*-values.yaml"))
EXAMPLES = sorted((CHART / "examples").glob("values-*.yaml"))

Object = dict[str, Any]
SCHEMA = json.loads((CHART / "values.schema.json").read_text())
Lookup = Callable[[str, str, str, str], Any]


class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Loads YAML and refuses duplicate keys, as server-side apply does."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Object:
        mapping: Object = super().construct_mapping(node, deep)
        assert len(mapping) == len(node.value), [key.value for key, _ in node.value]
        return mapping


class Files:
    """Helm's `.Files`."""

    def Get(self, name: str) -> str:  # noqa: N802
        return self.Glob(name).get(name, "")

    def Glob(self, pattern: str) -> dict[str, str]:  # noqa: N802
        found = (path for path in sorted(CHART.glob(pattern)) if path.is_file())
        return {path.relative_to(CHART).as_posix(): path.read_text() for path in found}


class Versions(set[str]):
    """Helm's `.Capabilities.APIVersions`."""

    def Has(self, version: str) -> bool:  # noqa: N802
        return version in self


def nothing(*words: str) -> Object:
    """Answer `lookup` as without a cluster (`helm template`)."""
    return {}


def a_namespace(level: str = "") -> Lookup:
    """Make a cluster with only the namespace, which may enforce a level of Pod Security."""
    labels = {"pod-security.kubernetes.io/enforce": level} if level else {}

    def lookup(version: str, kind: str, namespace: str, name: str) -> Object:
        return {"metadata": {"name": name, "labels": labels}} if kind == "Namespace" else {}

    return lookup


def holding(objects: Iterable[Object], otherwise: Lookup) -> Lookup:
    """Make a cluster with these objects."""

    def lookup(version: str, kind: str, namespace: str, name: str) -> Object:
        for found in objects:
            if (found["kind"], found["metadata"]["name"]) == (kind, name):
                return found
        return dict(otherwise(version, kind, namespace, name))

    return lookup


def laid_over(base: Any, values: Any) -> Any:
    """Merge values as helm does: mappings key by key; null removes a key."""
    if not isinstance(base, dict) or not isinstance(values, dict):
        return values
    merged = {key: laid_over(base.get(key), value) for key, value in values.items()}
    return {k: v for k, v in {**base, **merged}.items() if v is not None}


SOURCES = Files().Glob("templates/**/*")
cluster: list[Lookup] = []
"""The function that answers `lookup`, last in the list; templates are compiled only once."""


@cache
def engine() -> Any:
    def lookup(version: str, kind: str, namespace: str, name: str) -> Any:
        return cluster[-1](version, kind, namespace, name)

    return gotpl_helm.HelmTemplateEngine(SOURCES, lookup=lookup)


def render_texts(
    values: Object | None = None,
    *,
    release: str = "demo",
    namespace: str = "lab",
    lookup: Lookup = nothing,
    apis: Iterable[str] = (),
) -> dict[str, str]:
    """Render every template: path -> text; raise if the schema refuses the values."""
    import jsonschema

    merged = laid_over(values_of(CHART / "values.yaml"), values or {})
    jsonschema.Draft7Validator(SCHEMA).validate(merged)
    context = {
        "Values": copy.deepcopy(merged),
        "Release": {"Name": release, "Namespace": namespace, "Service": "Helm", "IsInstall": True},
        "Chart": {"Version": METADATA["version"], "AppVersion": METADATA["appVersion"]},
        "Capabilities": {"APIVersions": Versions(apis)},
        "Files": Files(),
    }
    wanted = [name for name in SOURCES if not name.endswith(".tpl")]
    cluster.append(lookup)
    try:
        return dict(engine().render(dict.fromkeys(wanted, context)))
    finally:
        cluster.pop()


def render(values: Object | None = None, **where: Any) -> list[Object]:
    """Render the objects of a release."""
    texts = render_texts(values, **where)
    objects = []
    for name, text in sorted(texts.items()):
        if not name.endswith("NOTES.txt"):
            objects += [found for found in yaml.load_all(text, Loader) if found]
    return objects


def notes(values: Object | None = None, **where: Any) -> str:
    return render_texts(values, **where)["templates/NOTES.txt"]


def of_kind(objects: Iterable[Object], kind: str) -> dict[str, Object]:
    """Select the objects of a kind, by the last part of their names: world, cloud, api..."""
    found = [thing for thing in objects if thing["kind"] == kind]
    return {thing["metadata"]["name"].removeprefix("demo-cloudrc-"): thing for thing in found}


def pod_specs(objects: Iterable[Object]) -> dict[str, Object]:
    """Return all pod specs: those of Deployments and Jobs by component, a Pod's by container."""
    specs = {}
    for thing in objects:
        if thing["kind"] in ("Deployment", "Job"):
            specs[component(thing)] = thing["spec"]["template"]["spec"]
        elif thing["kind"] == "Pod":
            specs[thing["spec"]["containers"][0]["name"]] = thing["spec"]
    return specs


def component(thing: Object) -> str:
    return str(thing["metadata"]["labels"]["app.kubernetes.io/component"])


def containers(spec: Object) -> dict[str, Object]:
    return {
        found["name"]: found for found in (*spec.get("initContainers", ()), *spec["containers"])
    }


def values_of(path: Path) -> Object:
    return dict(yaml.load(path.read_text(), Loader) or {})  # noqa: S506
