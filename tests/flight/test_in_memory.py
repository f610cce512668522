# SPDX-License-Identifier: Apache-2.0

"""Rows of flights that leave no files."""

from dataclasses import replace

from cloudrc.config.load import load_experiment
from cloudrc.flight.in_memory import fly_in_memory, row_of


def test_a_row_tells_the_notes_on_metrics_whatever_their_words():
    experiment = load_experiment("hover", ["criteria.time_limit_s=1"])
    found = fly_in_memory(experiment)
    assert found.metric_notes == ()
    told = replace(found, metric_notes=("any words",), notes=("metric x is a word", "any words"))
    before = row_of(found, experiment)["text"]
    assert before
    assert row_of(told, experiment)["text"] == f"{before}; any words"
