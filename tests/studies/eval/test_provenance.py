# SPDX-License-Identifier: Apache-2.0

"""An evaluation says how it was made, and how to cite it."""

import sys

import gymnasium

from cloudrc.studies.eval.provenance import provenance
from cloudrc.studies.eval.setup import EvalSetup


def test_versions_are_those_of_loaded_packages_and_of_the_environments_own(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    made = provenance(EvalSetup("pytest.x:X-v0", "law.py", link="lte"), "cloudrc eval")
    assert made["versions"]["gymnasium"] == gymnasium.__version__
    assert {"python", "cloudrc", "numpy", "mujoco", "pytest"} <= made["versions"].keys()
    assert "torch" not in made["versions"]
    assert made["profile"]["uplink"]["rate_kbit"] == 10_000
    assert made["profile"]["downlink"]["delay_ms"] == 20
