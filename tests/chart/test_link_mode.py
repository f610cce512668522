"""The namespace decides the mode of the link; the release shows it; an upgrade keeps it."""

from __future__ import annotations

import pytest

from tests.chart.conftest import (
    Lookup,
    Object,
    a_namespace,
    containers,
    holding,
    notes,
    nothing,
    of_kind,
    pod_specs,
    render,
)


def modes(lookup: Lookup, values: Object | None = None) -> set[str]:
    """Return the mode in the arguments of both link containers."""
    pods = pod_specs(render(values, lookup=lookup))
    found = (containers(pods[end])["link"]["args"] for end in ("world", "cloud"))
    return {text for arguments in found for text in arguments if text.startswith("--mode")}


@pytest.mark.parametrize(
    ("lookup", "mode"),
    [
        (nothing, "relay"),
        (a_namespace(), "auto"),
        (a_namespace("privileged"), "auto"),
        (a_namespace("baseline"), "relay"),
        (a_namespace("restricted"), "relay"),
    ],
    ids=["unseen", "no label", "privileged", "baseline", "restricted"],
)
def test_auto_follows_the_label_of_the_namespace(lookup: Lookup, mode: str) -> None:
    assert modes(lookup) == {f"--mode={mode}"}


@pytest.mark.parametrize("mode", ["relay", "netem"])
@pytest.mark.parametrize("level", ["", "restricted"])
def test_a_fixed_mode_ignores_the_namespace(mode: str, level: str) -> None:
    assert modes(a_namespace(level), {"link": {"mode": mode}}) == {f"--mode={mode}"}


@pytest.mark.parametrize(
    ("first", "later"),
    [
        # Helm creates the namespace (--create-namespace) after rendering: only an upgrade sees it.
        (nothing, a_namespace()),
        (a_namespace(), a_namespace()),
        (a_namespace("restricted"), a_namespace("restricted")),
    ],
    ids=["made by helm", "no label", "restricted"],
)
def test_an_upgrade_keeps_the_mode(first: Lookup, later: Lookup) -> None:
    installed = render(lookup=first)
    assert render(lookup=holding(installed, later)) == installed


def test_an_upgrade_obeys_a_new_label() -> None:
    installed = render(lookup=a_namespace())
    assert modes(holding(installed, a_namespace("restricted"))) == {"--mode=relay"}


def test_the_pods_have_an_annotation_with_the_mode() -> None:
    for deployment in of_kind(render(lookup=a_namespace()), "Deployment").values():
        annotations = deployment["spec"]["template"]["metadata"]["annotations"]
        assert annotations["cloudrc/link-mode"] == "auto"


def test_the_notes_show_mode_and_label_command() -> None:
    label = "kubectl label namespace lab pod-security.kubernetes.io/enforce=privileged --overwrite"
    assert "mode relay" in notes()
    assert label not in notes()
    for mode in ("netem", "auto"):
        text = notes({"link": {"mode": mode}}, lookup=a_namespace())
        assert f"mode {mode}" in text
        assert label in text
