# SPDX-License-Identifier: Apache-2.0

"""A place gives link, speed and cores; a key that is given wins over it."""

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from tests.config.conftest import refused

EDGE, CLOUD = "cloud.place=edge", "cloud.place=cloud"


def facts(experiment):
    cloud, link = experiment.cloud, experiment.link
    return link.profile, link.uplink.delay_ms, cloud.speed, cloud.cores


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ([EDGE], ("ideal", 5, 1, 2)),
        (["cloud.place=onboard"], ("ideal", 0, 0.2, None)),
        ([EDGE, "link.uplink.delay_ms=7", "cloud.speed=3"], ("ideal", 7, 3, 2)),
        ([CLOUD, "cloud.cores=null"], ("ideal", 30, 2, None)),
        ([CLOUD, "link.profile=lte"], ("lte", 30, 2, 16)),
    ],
)
def test_a_place_wins_over_the_profile_and_a_given_key_over_the_place(settings, expected):
    assert facts(load_experiment("steps", settings)) == expected


def test_keys_of_a_file_win_over_the_place_but_not_its_profile(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("{link: {profile: lte, uplink: {delay_ms: 9}}, cloud: {place: edge}}")
    assert facts(load_experiment(path)) == ("ideal", 9, 1, 2)
    assert load_experiment(path).link.downlink.delay_ms == 5


def test_a_dumped_experiment_keeps_its_place_or_takes_another(tmp_path):
    path = tmp_path / "config.yaml"
    edge = load_experiment("steps", [EDGE, "cloud.speed=3"])
    path.write_text(dump(edge))
    assert load_experiment(path) == edge
    assert facts(load_experiment(path, [CLOUD])) == ("ideal", 30, 3, 16)


def test_a_place_may_be_a_file_beside_the_experiment(tmp_path):
    (tmp_path / "hall.yaml").write_text("{profile: wifi, uplink: {delay_ms: 8}, speed: 4}")
    path = tmp_path / "own.yaml"
    path.write_text("cloud: {place: ./hall.yaml}")
    loaded = load_experiment(path)
    assert facts(loaded) == ("wifi", 8, 4, None)
    assert loaded.cloud.place == str(tmp_path / "hall.yaml")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["cloud.place=egde"], "edge"),
        (["fleet.robots=2", "fleet.vary=[{cloud.place: edge}]"], "same for all robots"),
    ],
)
def test_a_place_that_does_not_fit_is_refused(settings, words):
    assert words in refused("steps", *settings)
