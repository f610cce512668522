# SPDX-License-Identifier: Apache-2.0

"""`cloudrc identify`: known models are found, bad recordings are refused by name."""

from itertools import accumulate
from math import exp

import numpy as np
import pytest

from cloudrc.base.outside.document import parse_yaml
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.config.load import load_experiment
from cloudrc.results.metrics.velocity_loop import DT, identify, series
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.writer import McapWriter
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry
from cloudrc.wire.records import GroundTruth, GuardChange

TRUE = (0.3, 0.1, 0.95)  # time constant [s], dead time [s], gain


def steps(rng, count=3000):
    """Return a velocity that jumps every second, shape (count,)."""
    return np.repeat(rng.uniform(-1, 1, count // 100 + 1), 100)[:count]


def respond(given, constant, dead, gain):
    """Return the exact response of a first-order lag with a dead time of whole samples."""
    late = np.concatenate([np.zeros(round(dead / DT)), given])[: len(given)] * gain
    decay = exp(-DT / constant)
    lag = lambda v, u: decay * v + (1.0 - decay) * u  # noqa: E731
    return np.array(list(accumulate(late[:-1], lag, initial=0.0)))


def correlated(rng, count, deviation):
    """Return noise that stays alike for about half a second."""
    white = rng.normal(size=count) * deviation * np.sqrt(1.0 - 0.98**2)
    return np.array(list(accumulate(white, lambda a, b: 0.98 * a + b)))


def test_a_model_is_recovered_within_its_interval():
    """At least 80 % of the intervals hold the truth although the residuals are correlated."""
    inside = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        given = steps(rng)
        measured = respond(given, *TRUE) + correlated(rng, len(given), 0.03)
        fit = identify(given, measured)
        inside.append(np.abs(fit.values - TRUE) <= fit.half_widths)
        assert fit.values == pytest.approx(TRUE, abs=0.08)
        assert np.all(fit.half_widths < 0.15)
        assert fit.share > 0.95
    assert np.mean(inside) >= 0.8


def test_an_axis_that_does_not_follow_a_model_is_refused():
    given, other = (steps(np.random.default_rng(seed)) for seed in (1, 2))
    with pytest.raises(InvalidValueError, match=r"a first-order model explains -?\d+% of"):
        identify(given, other)


def records(seconds=30.0, track_s=(1.0, None)):
    """Yield world's records of a robot that follows steps on all axes, with the guard's states."""
    rng = np.random.default_rng(1)
    given = np.stack([steps(rng, round(seconds / DT)) for _ in range(3)], axis=1)
    flown = np.stack([respond(column, *TRUE) for column in given.T], axis=1)
    begin, end = track_s
    changes = [(begin, GuardState.TRACK)] + [(end, GuardState.HOLD)] * (end is not None)
    for k, (u, v) in enumerate(zip(given.tolist(), flown.tolist(), strict=True)):
        stamp_ns = round(k * DT * 1e9)
        for at_s, state in changes:
            if stamp_ns == round(at_s * 1e9):
                yield GuardChange(stamp_ns, state, "")
        truth = Odometry(stamp_ns, ZERO, UPRIGHT, tuple(v), ZERO)
        yield GroundTruth(stamp_ns, truth, tuple(u))


def test_only_the_flight_under_commands_counts():
    given, measured = series(Recording.from_records(records(track_s=(1.0, 28.0))))
    assert given.shape == measured.shape == (2500, 3)


def test_a_recording_that_is_not_enough_is_refused():
    with pytest.raises(InvalidValueError, match=r"12 s of flight under commands after.*needs 20 s"):
        series(Recording.from_records(records(track_s=(1.0, 15.0))))


def test_a_flight_whose_recording_is_still_written_is_not_read(tmp_path, call, refused):
    mission = tmp_path / "mission.mcap"
    with McapWriter(mission, clock="world") as writer:
        writer.write(records())
        writer.flush()
        for line in ("identify", "link record -o t.csv", "replay --no-open", "report --recover"):
            assert f"{tmp_path}: the flight has not ended" in refused(line, mission)
        assert "the flight has not ended" in refused("report", tmp_path)
    call("report --recover", mission)


def test_the_command_writes_a_model_that_a_predictor_takes(tmp_path, call, as_json):
    with McapWriter(tmp_path / "mission.mcap", clock="world") as writer:
        writer.write(records())
    shown = call("identify --out model.yaml", tmp_path).out
    assert "input /reference, output /ground_truth" in shown
    assert shown.splitlines()[-1] == "model.yaml"
    model = parse_yaml((tmp_path / "model.yaml").read_text(), "")[0]
    assert model["time_constant"] == pytest.approx([TRUE[0]] * 3, abs=0.01)
    assert model["dead_time"] == pytest.approx([TRUE[1]] * 3, abs=0.01)
    file = tmp_path / "own.yaml"
    file.write_text("mission: steps\nworld: {scene: empty}\n")
    for key, name in (("model", "command_history"), ("model_file", "kalman, model: first_order")):
        setting = f"cloud.predictor={{name: {name}, {key}: model.yaml}}"
        predictor = load_experiment(file, [setting]).cloud.predictor
        assert predictor.model_extra[key] == str(tmp_path / "model.yaml")
    error = call("identify", tmp_path, code=2).err
    assert "model.yaml: already there; name another file with --out" in error
    assert as_json("identify --out second.yaml", tmp_path) == {"schemaVersion": 1, **model}
