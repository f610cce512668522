"""`helm test` verifies the link: with enough time, and without rights in the cluster."""

from __future__ import annotations

from cloudrc.cli.link_verify import RELEASE_TIMEOUT
from cloudrc.cli.parser import build_parser
from tests.chart.conftest import Object, containers, pod_specs, render

HELM_WAITS = 300.0
"""Default timeout of helm for one hook [s]."""


def link_test(values: Object | None = None) -> Object:
    (found,) = (
        thing
        for thing in render(values)
        if thing["kind"] == "Pod" and thing["metadata"]["name"].endswith("-test-link")
    )
    return found


def test_it_runs_after_the_flight_and_stays_if_it_fails() -> None:
    annotations = link_test()["metadata"]["annotations"]
    assert annotations["helm.sh/hook"] == "test"
    assert int(annotations["helm.sh/hook-weight"]) > 0, "commands flow once a mission has flown"
    assert "hook-failed" not in annotations["helm.sh/hook-delete-policy"]
    assert link_test()["spec"]["restartPolicy"] == "Never"


def test_its_deadline_is_between_the_measurement_and_helms() -> None:
    deadline = link_test()["spec"]["activeDeadlineSeconds"]
    assert RELEASE_TIMEOUT + 10.0 <= deadline < HELM_WAITS


def test_its_command_verifies_the_link_of_this_release() -> None:
    (container,) = link_test()["spec"]["containers"]
    options = build_parser(["link"]).parse_args(container["args"])
    names = {name.rsplit("-", 1)[-1] for name in options.ends.split(",")}
    assert names == {"world", "cloud"}
    hosts = {thing["metadata"]["name"] for thing in render() if thing["kind"] == "Service"}
    assert set(options.ends.split(",")) <= hosts


def test_it_has_no_more_rights_than_cloud() -> None:
    own = link_test()["spec"]["containers"][0]["securityContext"]
    assert own == containers(pod_specs(render())["cloud"])["cloud"]["securityContext"]
    assert "NET_ADMIN" not in str(own)
