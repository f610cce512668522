"""Experiment and link profile reach the pods in files that the package reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from cloudrc.config.load import FILE_READERS, dump, load_experiment, load_profile
from cloudrc.config.shipped import names
from tests.chart.conftest import Object, containers, of_kind, pod_specs, render

MEASURED = {"drive.csv": "time_s,delay_ms\n0,30\n1,40\n2,35\n"}
NAMING: dict[str, Object] = {
    "trace": {"uplink": {"trace": "drive.csv"}},
    "table": {
        "uplink": {
            "delay_ms": 35,
            "jitter_ms": 4,
            "distribution": "table",
            "table": "drive.csv",
        }
    },
}
"""Key -> profile that names a file of `MEASURED` with this key."""


def config(objects: list[Object], name: str, folder: Path) -> Path:
    """Write the files of a ConfigMap as a pod sees them."""
    for file, text in of_kind(objects, "ConfigMap")[name]["data"].items():
        (folder / file).write_text(text)
    return folder


def profile(values: Object, folder: Path) -> Any:
    return load_profile(config(render(values), "link", folder) / "profile.yaml")


def templates(values: Object) -> dict[str, Object]:
    deployments = of_kind(render(values), "Deployment")
    return {name: thing["spec"]["template"] for name, thing in deployments.items()}


@pytest.mark.parametrize("name", names("experiment"))
def test_the_configmap_loads_as_the_same_experiment(name: str, tmp_path: Path) -> None:
    """The same holds for a resolved experiment."""
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


def test_a_large_seed_stays_an_integer(tmp_path: Path) -> None:
    written = config(render({"experiment": {"seed": 12_000_000}}), "experiment", tmp_path)
    assert load_experiment(written / "experiment.yaml").seed == 12_000_000


@pytest.mark.parametrize("name", names("profile"))
def test_a_shipped_profile_by_name(name: str, tmp_path: Path) -> None:
    assert profile({"link": {"profile": name}}, tmp_path) == load_profile(name)


def test_without_a_profile_the_experiments_link_is_used(tmp_path: Path) -> None:
    loss = {"bad_start": 0.1, "bad_end": 0.5}
    given = {"profile": "wifi", "uplink": {"delay_ms": 80, "loss": loss}}
    made, wifi = profile({"experiment": {"link": given}}, tmp_path), load_profile("wifi")
    assert made.uplink.delay_ms == 80
    assert made.uplink.loss.bad_start == 0.1
    assert made.uplink.jitter_ms == wifi.uplink.jitter_ms
    assert made.downlink == wifi.downlink


def test_a_profile_replaces_the_experiments_link(tmp_path: Path) -> None:
    values = {
        "experiment": {"link": {"uplink": {"delay_ms": 80}}},
        "link": {"profile": {"downlink": {"delay_ms": 5}}},
    }
    made = profile(values, tmp_path)
    assert (made.uplink.delay_ms, made.downlink.delay_ms) == (0, 5)


@pytest.mark.parametrize("key", FILE_READERS)
def test_a_profiles_file_is_in_its_configmap(key: str, tmp_path: Path) -> None:
    made = profile({"link": {"profile": NAMING[key], "traces": MEASURED}}, tmp_path)
    assert getattr(made.uplink, key) == str(tmp_path / "drive.csv")


@pytest.mark.parametrize("key", FILE_READERS)
def test_an_experiments_file_is_in_its_configmap(key: str, tmp_path: Path) -> None:
    """Every process loads the whole experiment, even if a profile replaces its link."""
    for link in ({"traces": MEASURED}, {"traces": MEASURED, "profile": "wifi"}):
        values = {"experiment": {"link": NAMING[key]}, "link": link}
        folder = config(render(values), "experiment", tmp_path)
        loaded = load_experiment(folder / "experiment.yaml")
        assert getattr(loaded.uplink, key) == str(tmp_path / "drive.csv")


@pytest.mark.parametrize("key", FILE_READERS)
def test_a_file_of_the_experiments_link_is_in_its_configmap(key: str, tmp_path: Path) -> None:
    made = profile({"experiment": {"link": NAMING[key]}, "link": {"traces": MEASURED}}, tmp_path)
    assert getattr(made.uplink, key) == str(tmp_path / "drive.csv")


def test_the_experiment_has_only_the_files_that_it_names() -> None:
    link = {"profile": NAMING["trace"], "traces": MEASURED}
    assert set(of_kind(render({"link": link}), "ConfigMap")["experiment"]["data"]) == {
        "experiment.yaml"
    }


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"link": {"profile": "wify"}}, "link.profile: no profile 'wify' ships.*choose one of 5g"),
        (
            {"experiment": {"link": {"profile": "./mine.yaml"}}},
            "experiment.link.profile: no profile './mine.yaml'.*profile under link.profile",
        ),
        ({"mission": {"enabled": True, "plan": "pipe"}}, "no mission 'pipe'.*one of hover, pipes"),
    ],
)
def test_an_unknown_profile_lists_the_known_ones(values: Object, said: str) -> None:
    with pytest.raises(Exception, match=said):
        render(values)


def test_a_changed_experiment_restarts_both_pods() -> None:
    before, after = templates({}), templates({"experiment": {"seed": 2}})
    for name in ("world", "cloud"):
        assert before[name] != after[name]
        annotations = after[name]["metadata"]["annotations"]
        changed = {
            k for k, v in annotations.items() if before[name]["metadata"]["annotations"][k] != v
        }
        assert changed == {"checksum/experiment"}


@pytest.mark.parametrize("link", [{"profile": "lossy"}, {"profile": {"uplink": {"delay_ms": 9}}}])
def test_a_changed_profile_changes_only_one_configmap(link: Object) -> None:
    before = {thing["metadata"]["name"]: thing for thing in render() if thing["kind"] != "Secret"}
    after = {
        thing["metadata"]["name"]: thing
        for thing in render({"link": link})
        if thing["kind"] != "Secret"
    }
    assert {name for name in before if before[name] != after[name]} == {"demo-cloudrc-link"}


def test_the_profile_is_mounted_as_a_directory() -> None:
    """The kubelet updates only directories in a running container."""
    for end in ("world", "cloud"):
        (link,) = pod_specs(render())[end]["initContainers"]
        mounts = {mount["mountPath"]: mount["name"] for mount in link["volumeMounts"]}
        assert mounts["/etc/cloudrc-link"] == "link"
        assert "--profile=/etc/cloudrc-link/profile.yaml" in link["args"]
        others = [c for name, c in containers(pod_specs(render())[end]).items() if name != "link"]
        assert not any("link" in {m["name"] for m in c["volumeMounts"]} for c in others)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            {"experiment": {"mission": "nonsense"}},
            "experiment.mission: no mission 'nonsense' .*pipe",
        ),
        (
            {"experiment": {"mission": "./mine.yaml"}},
            "experiment.mission: .*write the mission there",
        ),
        ({"experiment": {"cloud": {"predictor": "./my.py"}}}, r"cloud.predictor: '\./my.py' is a"),
        (
            {"experiment": {"cloud": {"controller": {"name": "a/b.py"}}}},
            "cloud.controller: 'a/b.py'",
        ),
        *(
            (
                {"link": {"profile": {"downlink": {key: "t.csv"}}}},
                f"link.profile: downlink.{key} names 't.csv', but link.traces has no such",
            )
            for key in FILE_READERS
        ),
        *(
            (
                {"link": {"profile": over}, "experiment": {"link": {"uplink": {key: "/my/t.csv"}}}},
                f"experiment.link: uplink.{key} names '/my/t.csv', but link.traces has no",
            )
            for key in FILE_READERS
            for over in ("wifi", None)
        ),
    ],
)
def test_names_that_pods_could_not_find_are_refused(values: Object, said: str) -> None:
    with pytest.raises(Exception, match=said):
        render(values)
