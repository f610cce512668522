# SPDX-License-Identifier: Apache-2.0

"""Names, arguments and notes fit together."""

import re
import shlex

import pytest

from cloudrc.doors.cli.parser import build_parser
from tests.chart.conftest import (
    containers,
    notes,
    of_kind,
    pod_specs,
    render,
)


@pytest.mark.parametrize(
    ("release", "values", "name"),
    [
        ("my-cloudrc", "", "my-cloudrc-world"),
        ("1rel", "fullnameOverride: robot", "robot-world"),
        ("d" * 53, "", "d" * 46 + "-world"),
    ],
)
def test_names_follow_release_and_override(release, values, name):
    objects = render(f"{values}\nmission: {{enabled: true}}", release=release)
    assert name in {thing["metadata"]["name"] for thing in objects}
    assert max(len(thing["metadata"]["name"]) for thing in objects) <= 63


EVERYTHING = """
mission: {enabled: true, queue: true}
console: {enabled: true}
ros: {enabled: true, steer: true}
cloud: {backgroundLoad: {enabled: true, workers: 3}}
recordings: {storage: 1Gi}
"""


def test_the_command_line_accepts_every_containers_arguments():
    pods = pod_specs(render(EVERYTHING))
    parts = ["link", "cloud", "teleop", "bridge", "console", "load"]
    assert list(containers(pods["cloud"])) == parts
    assert "seq 3" in containers(pods["cloud"])["load"]["command"][-1]
    parts = [part for pod in pods.values() for part in containers(pod).values() if "args" in part]
    assert len(parts) == 10
    for part in parts:
        arguments = [re.sub(r"\$\((\w+)\)", r"\1", text) for text in part["args"]]
        assert callable(build_parser([arguments[0]]).parse_args(arguments).execute)


def test_the_notes_are_three_commands_for_this_release():
    text = notes(release="flight", namespace="lab-7")
    wait, fly, logs = (shlex.split(line) for line in text.splitlines() if line.startswith("  "))
    for words in (wait, fly, logs):
        assert words[words.index("--namespace") + 1] == "lab-7"
    assert wait[wait.index("--selector") + 1] == "app.kubernetes.io/instance=flight"
    options = build_parser([fly[1]]).parse_args(fly[1:])
    assert (fly[0], options.namespace, options.release) == ("cloudrc", "lab-7", "flight")
    name = next(w.partition("/")[2] for w in logs if w.startswith("deployment/"))
    assert name in of_kind(render(release="flight"), "Deployment")
    assert logs[logs.index("--container") + 1] == "link"


SLOW = "experiment.guard.command_age_max_ms=800"
CLOSED = "No Prometheus may scrape"
KEEP = "teleop.journal.keep=true"
TOPICS = "topics of ROS 2, which know no token"


@pytest.mark.parametrize(
    ("values", "words", "warns"),
    [
        ("", SLOW, False),
        ("link: {profile: satellite}", SLOW, True),
        ("", CLOSED, True),
        ("", KEEP, True),
        ("networkPolicy: {enabled: false}", TOPICS, False),
        ("{networkPolicy: {enabled: false}, ros: {enabled: true}}", TOPICS, True),
    ],
)
def test_the_notes_warn_of_what_will_not_work(values, words, warns):
    """The guard's limit is in the experiment, because a change of the link restarts nothing."""
    assert (words in notes(values)) is warns
