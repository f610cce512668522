# SPDX-License-Identifier: Apache-2.0

"""Two valid settings together load, or are refused by a line that names one of them.

A pair may fail although each of its settings loads alone, for example because a derived value is
taken for one that the user has set. The tests load every pair, without plug-ins and with what
loads share read once: that takes 1 ms.
"""

import json
from itertools import combinations, product

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from cloudrc.config.schema import Experiment
from tests.conftest import nightly
from tests.support.keys import forms_of

pytestmark = pytest.mark.usefixtures("files_are_read_once")
OWN = """\
mission: {waypoints: [{position_m: [0, 0, 1.0]}]}
world: {scene: empty}
criteria: {time_limit_s: 40}
"""
FORMS = forms_of(Experiment)
NAMES = {
    **{"robot": "pelican", "scene": "empty", "profile": "paper-p2", "mission": "hover"},
    **{"estimator": "ewma", "predictor": "kalman", "controller": "pid"},
}
"""Last part of a key -> a name that fits it."""
CHOSEN = """
cloud=null
cloud={"controller": "pid"}
cloud.controller.speed_max=2
cloud.freeze_after_s=null
cloud.horizon_max_s=null
cloud.horizon_max_s=2
cloud.plan_s=0.4
cloud.predictor={"name": "last_sample"}
guard=null
guard={}
guard.command_age_max_ms=null
guard.command_age_max_ms=2000
guard.plan_max_s=0
guard.plan_max_s=0.8
guard.speed_max_mps=5
link=null
link={"profile": "paper-p3"}
link.profile=ideal
link.profile=satellite
link.profile=handover
link.both.delay_ms=300
link.uplink=null
link.uplink={"delay_ms": 30}
link.uplink.changes=[{"at_s": 3, "delay_ms": 50}]
link.uplink.loss={"bad_start": 0.1, "bad_end": 0.3}
link.downlink.blackouts=[{"start_s": 3, "duration_s": 0.4}]
mission=steps
mission.carrot={"speed_mps": 2}
mission.touch=null
"""
"""Settings that depend on each other, or replace many values."""


def values(key):
    """Yield values for a key, one of which should be valid."""
    yield from filter(None, [NAMES.get(key.rpartition(".")[2])])
    yield from (each for form in FORMS[key] for each in form.get("enum", ())[:1])
    yield from (True, 1, 0.5, 0, 100, [0.5, 0.5, 0.5], [1, 0], "x")


def load(file, *settings):
    return load_experiment(file, settings, build=False)


def key_of(setting):
    return setting.partition("=")[0]


def loads(file, *settings):
    try:
        load(file, *settings)
    except BadInputError:
        return False
    return True


valid = {}
"""Key -> a setting that was valid for another file."""


def valid_settings(file):
    """Return a setting for each key that has a value with which the experiment loads."""
    keys = [key for key in FORMS if "downlink" not in key]
    found = []
    for key in keys:
        tried = [f"{key}={json.dumps(value)}" for value in reversed([*values(key)])]
        tried = [*filter(None, [valid.get(key)]), *tried]
        if setting := next((one for one in tried if loads(file, one)), None):
            found.append(valid.setdefault(key, setting))
    return found


def blames_another_key(file, *settings):
    """Return the error of a pair if one of its lines names neither of the keys; else ""."""
    try:
        load(file, *settings)
    except BadInputError as error:
        lines = str(error).splitlines()[1:] or [str(error)]
        keys = {key_of(one).replace(".both", "") for one in settings}
        keys |= {key.rpartition(".")[2] for key in keys}
        if not all(any(key in line for key in keys) for line in lines):
            return f"{settings}: {error}"
    return ""


@pytest.fixture(params=["own", "resolved"])
def file(request, tmp_path):
    """A small experiment without the sections cloud and link, also with all values."""
    path = tmp_path / "own.yaml"
    path.write_text(OWN)
    if request.param == "resolved":
        path.write_text(dump(load_experiment(path)))
    return path


@pytest.mark.parametrize("step", [60, *nightly(1)])
def test_every_pair_of_valid_settings_loads_or_names_one_of_them(file, step):
    """Of pairs that are not of two chosen settings, try one of `step`."""
    single, chosen = valid_settings(file), CHOSEN.split("\n")[1:-1]
    assert [one for one in chosen if not loads(file, one)] == []
    assert len(single) > 60
    others = [*product(chosen, single), *combinations(single, 2)][::step]
    pairs = (*combinations(chosen, 2), *others)
    apart = [(one, two) for one, two in pairs if key_of(one) != key_of(two)]
    assert [text for pair in apart if (text := blames_another_key(file, *pair))] == []


def test_null_means_again_what_the_profile_gives(tmp_path):
    path = tmp_path / "resolved.yaml"
    path.write_text(dump(load_experiment("hover", ["link.profile=satellite"])))
    keys = ("cloud.horizon_max_s", "cloud.freeze_after_s", "guard.command_age_max_ms")
    before, after = load(path), load(path, *(f"{key}=null" for key in keys))
    assert (after.cloud, after.guard) == (before.cloud, before.guard)
