# SPDX-License-Identifier: Apache-2.0

"""Render the chart without helm.

gotpl is the template engine. As in helm, values are merged with the defaults and checked against
the schema. A cluster is a function that answers `lookup`.
"""

import copy
import json
from functools import cache
from pathlib import Path

import pytest
import yaml
from gotpl import ContextFunction, FunctionResult, RenderContext, TemplateExecutionError
from gotpl.exts import helm as gotpl_helm

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "charts" / "cloudrc"
METADATA = yaml.safe_load((CHART / "Chart.yaml").read_text())
VALUES = sorted((CHART / "ci").glob("*-values.yaml"))
VALUES += sorted((CHART / "examples").glob("values-*.yaml"))
SCHEMA = json.loads((CHART / "values.schema.json").read_text())
OPERATOR = "monitoring.coreos.com/v1"
each_file = pytest.mark.parametrize("path", VALUES, ids=lambda path: path.stem)


class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    """Loads YAML and refuses duplicate keys, as server-side apply does."""

    def construct_mapping(self, node, deep=False):
        mapping = super().construct_mapping(node, deep)
        assert len(mapping) == len(node.value), [key.value for key, _ in node.value]
        return mapping


@cache
def files_of(pattern):
    found = (path for path in sorted(CHART.glob(pattern)) if path.is_file())
    return {path.relative_to(CHART).as_posix(): path.read_text() for path in found}


class Files:
    """Helm's `.Files`."""

    def Get(self, name):  # noqa: N802
        return self.Glob(name).get(name, "")

    def Glob(self, pattern):  # noqa: N802
        return {**files_of(pattern)}


class Versions(set):
    """Helm's `.Capabilities.APIVersions`."""

    Has = set.__contains__


def nothing(*words):
    """Answer `lookup` without a cluster, as `helm template` does."""
    return {}


def a_namespace(level="", objects=()):
    """Make a cluster with objects and a namespace that enforces a level of Pod Security."""
    labels = {"pod-security.kubernetes.io/enforce": level} if level else {}

    def lookup(version, kind, namespace, name):
        for found in objects:
            if (found["kind"], found["metadata"]["name"]) == (kind, name):
                return found
        return {"metadata": {"name": name, "labels": labels}} if kind == "Namespace" else {}

    return lookup


def laid_over(base, values):
    """Merge values as helm does: mappings key by key; null removes a key."""
    if not isinstance(base, dict) or not isinstance(values, dict):
        return values
    merged = {key: laid_over(base.get(key), value) for key, value in values.items()}
    return {k: v for k, v in {**base, **merged}.items() if v is not None}


SOURCES = Files().Glob("templates/**/*")
cluster = []
"""The last function answers `lookup`; a list, because templates are compiled only once."""


made_of = {}
"""Template, and data without the values of a release -> text."""


def include(context: RenderContext, name: str, data: object) -> object:
    """Include a template; what it makes of the same data is made once: a third of the time."""
    key, whole = as_key(data, seen := []), context.state(include, dict)
    made = whole if seen else made_of  # the values of a release are the same while it is rendered
    if (name, key) in made:
        return made[name, key]
    text = including(context, name, data)
    if as_key(data, []) == key:  # else it has changed its data
        made[name, key] = text
    return text


def as_key(data, seen):
    """Make a key of the data of a template; note in `seen` all values of a release."""
    if isinstance(data, dict):
        if "Capabilities" in data:
            seen.append(data)
            return "all values"
        return "{}", *[(key, as_key(value, seen)) for key, value in data.items()]
    if isinstance(data, list | tuple):
        return "[]", *[as_key(value, seen) for value in data]
    return type(data), data


def including(context, name, data):
    try:
        return context.render_template(name, data)
    except TemplateExecutionError as error:
        return FunctionResult.failure(error, "")


class TextLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    """Leaves dates as text, as helm does."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [each for each in found if each[0] != "tag:yaml.org,2002:timestamp"]
        for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


def from_yaml(text: str) -> object:
    """Read YAML in C: that of the library takes a third of a rendering."""
    return yaml.load(text, TextLoader) or {}  # noqa: S506


@cache
def engine():
    return gotpl_helm.HelmTemplateEngine(
        SOURCES,
        lookup=lambda *words: cluster[-1](*words),
        custom_functions={"include": ContextFunction(include), "fromYaml": from_yaml},
    )


def read_values(text):
    return dict(yaml.load(text, Loader) or {})  # noqa: S506


def values_of(path):
    return read_values(path.read_text())


DEFAULTS = values_of(CHART / "values.yaml")


def render_texts(
    values=None,
    only="templates/",
    *,
    release="demo",
    namespace="lab",
    lookup=nothing,
    apis=(),
    upgrade=False,
    reused=None,
):
    """Render the templates under `only`: path -> text; raise if the schema refuses the values.

    `only` is the beginning of their paths, or a tuple of several. Values may be a text in YAML.
    `reused` are all values of an earlier install, in place of this chart's defaults, as with
    `helm upgrade --reuse-values`.
    """
    import jsonschema

    given = read_values(values) if isinstance(values, str) else values or {}
    merged = laid_over(reused or DEFAULTS, given)
    jsonschema.Draft7Validator(SCHEMA).validate(merged)
    about = {"Name": release, "Namespace": namespace, "Service": "Helm"}
    context = {
        "Values": copy.deepcopy(merged),
        "Release": {**about, "IsInstall": not upgrade, "IsUpgrade": upgrade},
        "Chart": {key[0].upper() + key[1:]: value for key, value in METADATA.items()},
        "Capabilities": {"APIVersions": Versions(apis)},
        "Files": Files(),
    }
    wanted = [name for name in SOURCES if name.startswith(only) and not name.endswith(".tpl")]
    cluster.append(lookup)
    try:
        return dict(engine().render(dict.fromkeys(wanted, context)))
    finally:
        cluster.pop()


kept = {}
"""Objects of releases without a cluster, in JSON: many tests look at the same ones."""


def render(values=None, *, lookup=nothing, **where):
    """Render the objects of a release."""
    key = repr((values, where))
    if lookup is nothing and key in kept:
        return json.loads(kept[key])
    texts = sorted(render_texts(values, lookup=lookup, **where).items())
    yamls = (text for name, text in texts if not name.endswith("NOTES.txt"))
    objects = [found for text in yamls for found in yaml.load_all(text, Loader) if found]
    if lookup is nothing:
        kept[key] = json.dumps(objects)
    return objects


def notes(values=None, **where):
    (text,) = render_texts(values, "templates/NOTES.txt", **where).values()
    return text


def of_kind(objects, kind):
    """Select the objects of a kind, by the last part of their names: world, cloud, api..."""
    found = [thing for thing in objects if thing["kind"] == kind]
    return {thing["metadata"]["name"].removeprefix("demo-cloudrc-"): thing for thing in found}


def pod_specs(objects):
    """Return all pod specs: by container for Pods, by component for all others."""
    specs = {}
    for thing in objects:
        spec = thing.get("spec", {})
        if thing["kind"] in ("Deployment", "StatefulSet", "Job"):
            component = thing["metadata"]["labels"]["app.kubernetes.io/component"]
            specs[component] = spec["template"]["spec"]
        elif thing["kind"] == "Pod":
            specs[spec["containers"][0]["name"]] = spec
    return specs


def containers(spec):
    found = (*spec.get("initContainers", ()), *spec["containers"])
    return {container["name"]: container for container in found}
