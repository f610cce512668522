"""Experiment and link profile reach the pods in files that the package reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from cloudrc.config.load import dump, load_experiment, load_profile
from cloudrc.config.shipped import names
from tests.chart.conftest import Object, of_kind, render

MEASURED = {"drive.csv": "time_s,delay_ms\n0,30\n1,40\n2,35\n"}
TABLE = {"delay_ms": 35, "jitter_ms": 4, "distribution": "table", "table": "drive.csv"}


def config(objects: list[Object], name: str, folder: Path) -> Path:
    """Write the files of a ConfigMap as a pod sees them."""
    for file, text in of_kind(objects, "ConfigMap")[name]["data"].items():
        (folder / file).write_text(text)
    return folder


def profile(values: Object, folder: Path) -> Any:
    return load_profile(config(render(values), "link", folder) / "profile.yaml")


@pytest.mark.parametrize("name", names("experiment"))
def test_the_configmap_loads_as_the_same_experiment(name: str, tmp_path: Path) -> None:
    resolved = load_experiment(name)
    values = {"experiment": yaml.safe_load(dump(resolved))}
    written = config(render(values), "experiment", tmp_path) / "experiment.yaml"
    assert load_experiment(written) == resolved
    link = profile(values, tmp_path)
    assert (link.uplink, link.downlink) == (resolved.uplink, resolved.downlink)


def test_the_default_experiment_is_the_papers_scheme(tmp_path: Path) -> None:
    written = config(render(), "experiment", tmp_path) / "experiment.yaml"
    loaded, paper = load_experiment(written), load_experiment("paper")
    for key in ("mission", "world", "guard", "tunnel", "link", "cloud", "criteria"):
        assert getattr(loaded, key) == getattr(paper, key)
    written = config(render({"experiment": {"seed": 12_000_000}}), "experiment", tmp_path)
    assert load_experiment(written / "experiment.yaml").seed == 12_000_000


@pytest.mark.parametrize("name", names("profile"))
def test_a_shipped_profile_by_name(name: str, tmp_path: Path) -> None:
    assert profile({"link": {"profile": name}}, tmp_path) == load_profile(name)


def test_a_profile_replaces_the_experiments_link(tmp_path: Path) -> None:
    loss = {"bad_start": 0.1, "bad_end": 0.5}
    link = {"profile": "wifi", "uplink": {"delay_ms": 80, "loss": loss}}
    made, wifi = profile({"experiment": {"link": link}}, tmp_path), load_profile("wifi")
    assert (made.uplink.delay_ms, made.uplink.loss.bad_start) == (80, 0.1)
    assert made.uplink.jitter_ms == wifi.uplink.jitter_ms
    assert made.downlink == wifi.downlink
    own = {"profile": {"downlink": {"delay_ms": 5}}}
    made = profile({"experiment": {"link": link}, "link": own}, tmp_path)
    assert (made.uplink.delay_ms, made.downlink.delay_ms) == (0, 5)


@pytest.mark.parametrize(("key", "way"), [("trace", {"trace": "drive.csv"}), ("table", TABLE)])
def test_a_named_file_is_in_each_configmap_that_names_it(
    key: str, way: Object, tmp_path: Path
) -> None:
    """Every process loads the whole experiment, even if a profile replaces its link."""
    file = str(tmp_path / "drive.csv")
    of_profile = {"link": {"profile": {"uplink": way}, "traces": MEASURED}}
    assert getattr(profile(of_profile, tmp_path).uplink, key) == file
    data = of_kind(render(of_profile), "ConfigMap")["experiment"]["data"]
    assert set(data) == {"experiment.yaml"}
    of_experiment = {"experiment": {"link": {"uplink": way}}, "link": {"traces": MEASURED}}
    assert getattr(profile(of_experiment, tmp_path).uplink, key) == file
    for over in ({}, {"profile": "wifi"}):
        values = {**of_experiment, "link": {"traces": MEASURED, **over}}
        folder = config(render(values), "experiment", tmp_path)
        loaded = load_experiment(folder / "experiment.yaml")
        assert getattr(loaded.uplink, key) == file


def test_a_change_restarts_only_what_it_must() -> None:
    def named(values: Object) -> dict[tuple[str, str], Object]:
        found = (thing for thing in render(values) if thing["kind"] != "Secret")
        return {(thing["kind"], thing["metadata"]["name"]): thing for thing in found}

    before, seeded = named({}), named({"experiment": {"seed": 2}})
    for end in ("world", "cloud"):
        old, new = (
            each["Deployment", f"demo-cloudrc-{end}"]["spec"]["template"]["metadata"]["annotations"]
            for each in (before, seeded)
        )
        assert {key for key in new if old[key] != new[key]} == {"checksum/experiment"}
    after = named({"link": {"profile": "lossy"}})
    assert {key for key in before if before[key] != after[key]} == {
        ("ConfigMap", "demo-cloudrc-link")
    }


UNKNOWN = "experiment.mission: no mission 'nonsense' .*pipe"


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"link": {"profile": "wify"}}, "link.profile: no profile 'wify' ships.*choose one of 5g"),
        ({"mission": {"enabled": True, "plan": "pipe"}}, "no mission 'pipe'.*one of hover, pipes"),
        (
            {"experiment": {"link": {"profile": "./mine.yaml"}}},
            "experiment.link.profile: no profile './mine.yaml'.*profile under link.profile",
        ),
        ({"experiment": {"mission": "nonsense"}}, UNKNOWN),
        ({"experiment": {"mission": "./a.yaml"}}, "experiment.mission: .*write the mission there"),
        ({"experiment": {"cloud": {"predictor": "./my.py"}}}, r"cloud.predictor: '\./my.py' is a"),
        ({"experiment": {"cloud": {"controller": {"name": "a/b.py"}}}}, "controller: 'a/b.py'"),
        (
            {"experiment": {"link": {"uplink": {"table": "/t.csv"}}}},
            "experiment.link: uplink.table names '/t.csv', but link.traces has no",
        ),
        (
            {"link": {"profile": {"downlink": {"table": "t.csv"}}}},
            "link.profile: downlink.table names 't.csv', but link.traces has no such",
        ),
        (
            {"link": {"profile": "wifi"}, "experiment": {"link": {"uplink": {"trace": "/t.csv"}}}},
            "experiment.link: uplink.trace names '/t.csv', but link.traces has no",
        ),
    ],
)
def test_names_that_pods_could_not_find_are_refused(values: Object, said: str) -> None:
    with pytest.raises(Exception, match=said):
        render(values)
