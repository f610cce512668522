# SPDX-License-Identifier: Apache-2.0

"""The link's mode follows the namespace; `helm test` verifies the link."""

import pytest

from tests.chart.conftest import a_namespace, containers, nothing, pod_specs, render

ENDS = "templates/world/", "templates/cloud/"


def modes(lookup, values=None):
    """Return the mode in the arguments of both link containers."""
    pods = pod_specs(render(values, only=ENDS, lookup=lookup))
    found = (containers(pods[end])["link"]["args"] for end in ("world", "cloud"))
    return {text for arguments in found for text in arguments if text.startswith("--mode")}


@pytest.mark.parametrize(
    ("lookup", "mode"),
    [(nothing, "relay"), (a_namespace(), "auto"), (a_namespace("restricted"), "relay")],
)
def test_auto_follows_the_label_of_the_namespace(lookup, mode):
    assert modes(lookup) == {f"--mode={mode}"}
    for fixed in ("relay", "netem"):
        assert modes(lookup, {"link": {"mode": fixed}}) == {f"--mode={fixed}"}


def test_an_upgrade_keeps_the_mode_unless_the_label_is_new():
    """Helm creates the namespace (--create-namespace) after rendering: only an upgrade sees it."""
    installed = render(lookup=nothing)
    assert render(lookup=a_namespace(objects=installed)) == installed
    installed = render(lookup=a_namespace())
    assert modes(a_namespace("restricted", installed)) == {"--mode=relay"}
