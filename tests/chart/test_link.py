"""The link's mode follows the namespace; `helm test` verifies the link."""

import pytest

from cloudrc.cli.parser import build_parser
from cloudrc.runs.links.verify import RELEASE_TIMEOUT
from tests.chart.conftest import a_namespace, containers, nothing, of_kind, pod_specs, render


def modes(lookup, values=None):
    """Return the mode in the arguments of both link containers."""
    pods = pod_specs(render(values, lookup=lookup))
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


def test_helm_test_verifies_the_link_of_this_release():
    objects = render()
    (test,) = (t for name, t in of_kind(objects, "Pod").items() if name.endswith("test-link"))
    annotations, spec = test["metadata"]["annotations"], test["spec"]
    assert int(annotations["helm.sh/hook-weight"]) > 0, "commands flow once a mission has flown"
    assert "hook-failed" not in annotations["helm.sh/hook-delete-policy"]
    # Helm waits 300 s for one hook.
    assert RELEASE_TIMEOUT + 10.0 <= spec["activeDeadlineSeconds"] < 300.0
    (container,) = spec["containers"]
    hosts = build_parser(["link"]).parse_args(container["args"]).ends.split(",")
    services = of_kind(objects, "Service")
    assert hosts == [services[end]["metadata"]["name"] for end in ("world", "cloud")]
