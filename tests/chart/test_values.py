# SPDX-License-Identifier: Apache-2.0

"""The schema is closed, the defaults are valid, and a wrong value is named."""

import pytest

from tests.chart.conftest import CHART, SCHEMA, render, values_of

jsonschema = pytest.importorskip("jsonschema", reason="comes with kubernetes-validate, extra dev")

DEFAULTS = values_of(CHART / "values.yaml")
# Values that Helm, Kubernetes or a plug-in defines and checks.
CONTEXTS = {"podSecurityContext", "containerSecurityContext"}
EXTRAS = {"extraEnv", "extraVolumes", "extraVolumeMounts", "extraObjects"}
OPEN = (
    {
        "global",
        "affinity",
        "tolerations",
        "topologySpreadConstraints",
        "allowFrom",
        "dns",
        "parentRefs",
    }
    | CONTEXTS
    | EXTRAS
)


def parts(node, path=()):
    """Yield every part of the schema with its path."""
    if isinstance(node, dict):
        yield path, node
        for key, inner in node.items():
            yield from parts(inner, (*path, key))
    for inner in node if isinstance(node, list) else ():
        yield from parts(inner, path)


def test_the_schema_is_closed_at_every_level():
    for path, part in parts(SCHEMA):
        if part.get("type") != "object" or OPEN & set(path):
            continue
        extra = part.get("additionalProperties", True)
        # Closed, or a map of one kind of value: labels, annotations, parameters of a plug-in.
        assert extra is False or (isinstance(extra, dict) and extra.get("type")), path


def test_the_defaults_are_valid_and_written_out():
    assert render("global: {anything: {goes: true}}"), "values of a parent chart"
    assert DEFAULTS.keys() == SCHEMA["properties"].keys() - {"global", "enabled"}


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ("lnk: {}", "lnk"),
        ("link: {profile: {uplink: {delay: 40}}}", "delay"),
        ("experiment: {guard: {command_age_max_ms: -1}}", "-1"),
        ("experiment: {seed: 9007199254740992}", "9007199254740992"),
        ("world: {podLabels: {app.kubernetes.io/name: x}}", "app.kubernetes.io/name"),
    ],
)
def test_a_wrong_value_is_refused_and_named(values, named):
    with pytest.raises(jsonschema.ValidationError) as caught:
        render(values)
    errors = [caught.value, *(caught.value.context or ())]
    assert any(named in error.message for error in errors)
