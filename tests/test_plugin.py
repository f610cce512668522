# SPDX-License-Identifier: Apache-2.0

"""`cloudrc.plugin` has all that a user's file imports, and loads of it only what is used."""

import pytest

import cloudrc
from cloudrc import plugin
from tests.support.programs import loaded


@pytest.mark.parametrize("module", [cloudrc, plugin], ids=["cloudrc", "plugin"])
def test_each_public_name_is_there_and_no_other(module):
    assert {*module.__all__} - {"__version__"} == {*module._HOMES}
    for name in module.__all__:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'Pilot'"):
        _ = module.Pilot


def test_a_predictor_loads_neither_environments_nor_recordings_nor_figures():
    found = loaded("from cloudrc.plugin import Odometry, Predictor")
    assert "cloudrc.cloud.predictors" in found
    assert not {"gymnasium", "matplotlib", "mcap", "mujoco", "cloudrc.results"} & found
    assert not {name for name in loaded("import cloudrc.plugin") if name.startswith("cloudrc.w")}
