"""The notes that helm prints after an install: three commands, and warnings."""

from __future__ import annotations

import shlex

import pytest

from tests.chart.conftest import Object, component, notes, of_kind, render


def commands(text: str) -> list[list[str]]:
    lines = (line.strip() for line in text.splitlines() if line.startswith("  "))
    return [shlex.split(line) for line in lines]


def test_three_commands_name_release_and_namespace() -> None:
    found = commands(notes(release="flight", namespace="lab-7"))
    assert [words[0] for words in found] == ["kubectl", "cloudrc", "kubectl"]
    for words in found:
        assert words[words.index("--namespace") + 1] == "lab-7"
    assert any("flight" in word for word in found[0])
    assert found[1][found[1].index("--release") + 1] == "flight"


def test_the_first_command_waits_for_both_pods() -> None:
    words = commands(notes())[0]
    key, value = words[words.index("--selector") + 1].split("=")
    deployments = of_kind(render(), "Deployment")
    selected = [component(t) for t in deployments.values() if t["metadata"]["labels"][key] == value]
    assert sorted(selected) == ["cloud", "world"]


def test_the_second_command_is_valid() -> None:
    from cloudrc.cli.parser import build_parser

    words = commands(notes())[1]
    assert words[0] == "cloudrc"
    options = build_parser([words[1]]).parse_args(words[1:])
    assert (options.namespace, options.release) == ("lab", "demo")


def test_the_third_command_names_existing_objects() -> None:
    words = commands(notes())[2]
    deployment = next(w.partition("/")[2] for w in words if w.startswith("deployment/"))
    (thing,) = (
        t for t in of_kind(render(), "Deployment").values() if t["metadata"]["name"] == deployment
    )
    names = [c["name"] for c in thing["spec"]["template"]["spec"]["initContainers"]]
    assert words[words.index("--container") + 1] in names


@pytest.mark.parametrize(
    ("values", "warns"),
    [
        ({}, False),
        ({"link": {"profile": "satellite"}}, True),
        (
            {
                "link": {"profile": "satellite"},
                "experiment": {"guard": {"command_age_max_ms": 800}},
            },
            False,
        ),
        ({"experiment": {"link": {"profile": "satellite"}}}, False),
    ],
)
def test_a_slow_profile_warns_about_its_command_age(values: Object, warns: bool) -> None:
    """The guard's limit is in the experiment, because a change of the link restarts nothing."""
    assert ("experiment.guard.command_age_max_ms=800" in notes(values)) is warns


def test_the_notes_warn_of_open_networks_and_closed_metrics() -> None:
    assert "No Prometheus may scrape" in notes()
    admitted = {"metrics": {"allowFrom": [{"ipBlock": {"cidr": "10.0.0.0/8"}}]}}
    assert "No Prometheus may scrape" not in notes(admitted)
    assert "WARNING: networkPolicy.enabled is false" in notes({"networkPolicy": {"enabled": False}})
