# SPDX-License-Identifier: Apache-2.0

"""Every door reads the same numbers: flags, keys of files, columns, the API, results of plug-ins.

The tests find flags and keys by walking them, so that a new one is tested by itself.
"""

import argparse
import json
from functools import partial

import gymnasium
import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.document import parse_value, parse_yaml
from cloudrc.base.outside.tables import Column, Row
from cloudrc.base.outside.values import ANY, RESULT, WHOLE, InvalidValueError, Quantity
from cloudrc.cloud.controllers import ControlOutput
from cloudrc.cloud.results import check_estimate, check_output
from cloudrc.config.profile import Profile
from cloudrc.config.schema import Experiment
from cloudrc.doors import api
from cloudrc.doors.cli.parser import COMMANDS, NumberFlag, build_parser
from cloudrc.flight.experiment import load
from cloudrc.gym import Networked
from cloudrc.link import open as open_link
from cloudrc.link.library import read_profile
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry
from tests.base.outside.values import OBJECTS, TEXTS, disagreements, taken_otherwise
from tests.support.keys import forms_of, limits_of


def flags(parser, command=""):
    """Yield name and type of each flag of a parser and of its verbs."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield from flags(inner, f"{command} {name}")
        elif action.type is not None:
            yield f"{command} {'/'.join(action.option_strings) or action.dest}", action.type


FLAGS = {**dict(flags(build_parser(COMMANDS)))}
NUMBERS = {name: each for name, each in FLAGS.items() if isinstance(each, NumberFlag)}


def test_no_flag_reads_a_number_in_another_way():
    assert len(NUMBERS) > 30
    assert [name for name, each in FLAGS.items() if each in (int, float)] == []


@pytest.mark.parametrize("name", NUMBERS)
def test_a_flag_reads_what_the_table_says(name):
    read = NUMBERS[name]
    assert disagreements(TEXTS.items(), read.quantity, read, argparse.ArgumentTypeError) == []


NEED_ANOTHER = {"compute_deviation_ms", "cpu_share", "send_delta_mps", "cores", "only"}
NEED_ANOTHER |= {
    "slot_ms",
    "request_ms",
}  # of a radio: the one is a multiple of the other's pattern


def keys(model):
    """Yield path and quantity of each key of a model whose value is a number or null."""
    for name, forms in forms_of(model).items():
        path = tuple(name.split("."))
        # Below some keys there are keys that must be given, and some keys need another key.
        is_alone = {"0", "follow", "loss", "touch"}.isdisjoint(path[:-1])
        one = [form for form in forms if form.get("type") != "null"]
        is_number = len(one) == 1 and one[0].get("type") in ("number", "integer")
        is_alone = is_alone and path[-1] not in NEED_ANOTHER
        if is_alone and is_number and "enum" not in one[0]:
            yield path, Quantity(**limits_of(one[0]), whole=one[0]["type"] == "integer")


EXPERIMENT = dict(keys(Experiment))
PROFILE = {path: quantity for path, quantity in keys(Profile) if len(path) == 2}


def value_at(path, value):
    """Return what an experiment has for a value at a path, where others have their defaults."""
    tree = value
    for key in reversed(path):
        tree = {key: tree}
    found = Experiment.model_validate_json(json.dumps(tree))
    for key in path:
        found = getattr(found, key)
    return found


@pytest.mark.parametrize("path", EXPERIMENT, ids=".".join)
def test_a_key_reads_what_the_table_says_in_a_file_and_in_a_setting(path):
    assert len(EXPERIMENT) > 40
    texts, quantity = TEXTS.items(), EXPERIMENT[path]
    refused = (ValueError, BadInputError)

    def from_file(text):
        return value_at(path, parse_yaml(f"key: {text}", "file")[0]["key"])

    def from_setting(text):
        return value_at(path, parse_value(text, "--set"))

    assert disagreements(texts, quantity, from_file, refused) == []
    assert disagreements(texts, quantity, from_setting, refused) == []


@pytest.mark.parametrize("path", PROFILE, ids=".".join)
def test_a_mapping_of_a_profile_reads_what_the_table_says(path):
    way, key = path

    def take(value):
        if value is None:
            raise BadInputError("null is the default of some keys")
        read_profile({way: {key: value}})

    assert taken_otherwise(PROFILE[path], take) == []


def test_a_cell_of_a_csv_file_reads_what_the_table_says():
    def read(text):
        return Row("file", 2, [text]).number(Column("delay_ms", 0, 1.0, ANY))

    texts = TEXTS | {" 5 ": 5}
    assert disagreements(texts.items(), ANY, read, BadInputError) == []


SAMPLE, STILL = Odometry(7, ZERO, UPRIGHT, ZERO, ZERO), ControlOutput(ZERO, 0.0)
RESULTS = {
    "stamp": (WHOLE, lambda value: check_estimate(SAMPLE._replace(stamp_ns=value)).stamp_ns),
    "position": (
        RESULT,
        lambda value: check_estimate(SAMPLE._replace(position=(0.0, value, 0.0))).position[1],
    ),
    "velocity": (
        RESULT,
        lambda value: check_output(STILL._replace(velocity=[0.0, value, 0.0])).velocity[1],
    ),
    "yaw rate": (RESULT, lambda value: check_output(STILL._replace(yaw_rate=value)).yaw_rate),
}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_of_a_plug_in_is_judged_as_the_table_says(name):
    quantity, read = RESULTS[name]
    assert disagreements(OBJECTS, quantity, read, InvalidValueError) == []


def networked(value, name):
    """Make an environment behind a link with one argument."""
    if value is None:
        raise BadInputError("None is the default of some arguments")
    Networked(gymnasium.make("Pendulum-v1"), **{name: value})


def fly_with(seed):
    """Load what `fly` loads before it flies; None is the seed of the experiment."""
    if seed is None:
        raise BadInputError("None is the default")
    load("steps", api._texts({"seed": seed}))


SEEDS, SIZES = Quantity(ge=0, le=2**53 - 1, whole=True), Quantity(ge=0, le=10**9, whole=True)
CALLS = {
    "open seed": (SEEDS, lambda value: open_link("ideal", value)),
    "send number": (SIZES, lambda value: open_link("lte", 1)[0].send(0, value, 5, 0)),
    "table count": (SIZES, lambda value: open_link("lte", 1)[0].table(value, 0.01)),
    "fly seed": (SEEDS, fly_with),
    "fly setting": (
        Quantity(ge=0),
        lambda value: load("steps", api._texts({"link.uplink.jitter_ms": value}), 1),
    ),
    "gym dt": (Quantity(gt=0, le=3600), partial(networked, name="dt")),
    "gym seed": (SEEDS, partial(networked, name="seed")),
    "gym chunk": (Quantity(ge=1, le=10_000, whole=True), partial(networked, name="chunk")),
    "gym bytes": (SIZES, partial(networked, name="action_bytes")),
    "gym compute": (Quantity(ge=0, le=3600), partial(networked, name="compute")),
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.filterwarnings("ignore:dt. a step")
def test_an_argument_of_a_call_reads_what_the_table_says(name):
    quantity, take = CALLS[name]
    assert taken_otherwise(quantity, take) == []
