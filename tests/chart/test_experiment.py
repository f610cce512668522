# SPDX-License-Identifier: Apache-2.0

"""Experiment and link profile reach the pods in files that the package reads."""

import shutil

import pytest
import yaml

from cloudrc.config.load import load_experiment, load_link
from cloudrc.config.profile import load_profile
from cloudrc.config.resolved import dump
from cloudrc.config.shipped import names
from tests.chart.conftest import of_kind, pod_specs, render

MEASURED = {"drive.csv": "time_s,delay_ms\n0,30\n1,40\n2,35\n"}
CONFIGS = "templates/shared/experiment.yaml", "templates/link/"
TABLE = {"delay_ms": 35, "jitter_ms": 4, "distribution": "table", "table": "drive.csv"}


@pytest.fixture
def config(tmp_path):
    """Write the files of a ConfigMap as a pod sees them, into a folder of its own."""

    def write(values, name, **where):
        shutil.rmtree(tmp_path / name, ignore_errors=True)
        (tmp_path / name).mkdir()
        for file, text in of_kind(render(values, **where), "ConfigMap")[name]["data"].items():
            (tmp_path / name / file).write_text(text)
        return tmp_path / name

    return write


@pytest.fixture
def experiment(config):
    return lambda values, **where: load_experiment(
        config(values, "experiment", **where) / "experiment.yaml"
    )


@pytest.fixture
def profile(config):
    """Load the link as the link container does."""

    def load(values, only=CONFIGS):
        link, whole = (config(values, name, only=only) for name in ("link", "experiment"))
        return load_link(link / "profile.yaml", whole / "experiment.yaml")

    return load


@pytest.mark.parametrize("name", names("experiment"))
def test_the_configmap_loads_as_the_same_experiment(name, experiment, profile):
    resolved = load_experiment(name)
    values = {"experiment": yaml.safe_load(dump(resolved))}
    assert experiment(values) == resolved
    link = profile(values, only="templates/")
    assert (link.uplink, link.downlink) == (resolved.uplink, resolved.downlink)


def test_a_profile_replaces_the_experiments_link(profile):
    link = "link: {profile: wifi, uplink: {delay_ms: 80, loss: {bad_start: 0.1, bad_end: 0.5}}}"
    made, wifi = profile(f"experiment: {{{link}}}"), load_profile("wifi")
    assert (made.uplink.delay_ms, made.uplink.loss.bad_start) == (80, 0.1)
    assert made.uplink.jitter_ms == wifi.uplink.jitter_ms
    assert made.downlink == wifi.downlink
    own = "link: {profile: {downlink: {delay_ms: 5}}}"
    made = profile(f"{{experiment: {{{link}}}, {own}}}")
    assert (made.uplink.delay_ms, made.downlink.delay_ms) == (0, 5)
    assert profile("link: {profile: lossy}") == load_profile("lossy")


@pytest.mark.parametrize(("key", "way"), [("trace", {"trace": "drive.csv"}), ("table", TABLE)])
def test_a_named_file_is_in_each_configmap_that_names_it(key, way, tmp_path, experiment, profile):
    """Every process loads the whole experiment, even if a profile replaces its link."""
    file = str(tmp_path / "experiment" / "drive.csv")
    of_profile = {"link": {"profile": {"uplink": way}, "traces": MEASURED}}
    assert getattr(profile(of_profile).uplink, key) == str(tmp_path / "link" / "drive.csv")
    of_experiment = {"experiment": {"link": {"uplink": way}}, "link": {"traces": MEASURED}}
    assert getattr(profile(of_experiment).uplink, key) == file
    for over in ({}, {"profile": "wifi"}):
        values = {**of_experiment, "link": {"traces": MEASURED, **over}}
        assert getattr(experiment(values, only=CONFIGS).uplink, key) == file


def test_h264_needs_images_of_ones_own():
    values = {"experiment": {"camera": {"codec": "h264"}}}
    with pytest.raises(Exception, match="h264 needs PyAV"):
        render(values)
    own = {"worldCamera": {"repository": "lab/world"}, "cloud": {"repository": "lab/cloud"}}
    pods = pod_specs(render({**values, "image": own}))
    assert [
        pods[end]["containers"][0]["image"].partition(":")[0] for end in ("world", "cloud")
    ] == [
        "lab/world",
        "lab/cloud",
    ]


def test_a_change_restarts_only_what_it_must():
    def named(values):
        found = (thing for thing in render(values) if thing["kind"] != "Secret")
        return {(thing["kind"], thing["metadata"]["name"]): thing for thing in found}

    before, seeded = named(""), named("experiment: {seed: 2}")
    for end in ("world", "cloud"):
        old, new = (
            each["Deployment", f"demo-cloudrc-{end}"]["spec"]["template"]["metadata"]["annotations"]
            for each in (before, seeded)
        )
        assert {key for key in new if old[key] != new[key]} == {"checksum/experiment"}
    after = named("link: {profile: lossy}")
    differ = {key for key in before if before[key] != after[key]}
    assert differ == {("ConfigMap", "demo-cloudrc-link")}
