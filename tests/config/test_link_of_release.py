# SPDX-License-Identifier: Apache-2.0

"""The link of a release: a profile, the name of one, or the link of the experiment."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment, load_link
from cloudrc.config.profile import load_profile
from cloudrc.config.resolved import dump


@pytest.fixture
def link(tmp_path):
    def load(profile, experiment="{}"):
        (tmp_path / "profile.yaml").write_text(profile)
        (tmp_path / "experiment.yaml").write_text(experiment)
        return load_link(tmp_path / "profile.yaml", tmp_path / "experiment.yaml")

    return load


def test_a_name_is_that_of_a_shipped_profile(link):
    assert link("profile: wifi") == load_profile("wifi")
    with pytest.raises(BadInputError, match=r"no profile named 'wify'.*did you mean wifi"):
        link("profile: wify")
    with pytest.raises(BadInputError, match=r"no profile named '\./x\.yaml'"):
        link("profile: ./x.yaml")


def test_without_a_name_the_link_is_that_of_the_experiment_whatever_its_robot(link):
    own = "{world: {robot: /not/here}, link: {profile: wifi, uplink: {delay_ms: 80}}}"
    found, wifi = link("profile: null", own), load_profile("wifi")
    assert (found.uplink.delay_ms, found.uplink.jitter_ms) == (80, wifi.uplink.jitter_ms)
    assert found.downlink == wifi.downlink
    default = load_experiment("paper")
    assert link("profile: null") == link("profile: null", dump(default))
    assert link("profile: null").uplink == default.uplink


def test_without_a_name_the_link_is_that_of_the_experiments_place(link):
    found = link("profile: null", "{cloud: {place: edge}, link: {uplink: {delay_ms: 80}}}")
    assert (found.uplink.delay_ms, found.downlink.delay_ms) == (80, 5)
    with pytest.raises(BadInputError, match=r"no place named 'egde'.*did you mean edge"):
        link("profile: null", "{cloud: {place: egde}}")
