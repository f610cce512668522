"""A file of flights: the same flights in a pod that has none of the user's files."""

import gzip

import pytest

from cloudrc.errors import BadInputError
from cloudrc.sweep.plan import pack, read_plan, unpack


@pytest.fixture
def flights(tmp_path):
    (tmp_path / "mine.yaml").write_text("mission: steps\nworld: {scene: empty}\n")
    text = "experiment: ./mine.yaml\ngrid: {cloud.predictor: [last_sample, constant_velocity]}\n"
    (tmp_path / "sweep.yaml").write_text(text + "seeds: [3, 1]\n")
    return [*read_plan(tmp_path / "sweep.yaml").flights.values()]


@pytest.mark.parametrize("some", [slice(None), slice(1, 3)])
def test_the_flights_are_the_same_in_a_pod(flights, tmp_path, some):
    (tmp_path / "flights").write_bytes(pack(flights[some]))
    (tmp_path / "mine.yaml").unlink()
    assert unpack(tmp_path / "flights") == flights[some]


def test_100_000_flights_fit_into_a_configmap(flights):
    many = [flights[0]._replace(seed=seed) for seed in range(100_000)]
    assert len(pack(many)) < 700_000


OTHER = gzip.compress(b'{"points": [[{}, {}]]}', mtime=0)


@pytest.mark.parametrize("content", [b"", b"no gzip", OTHER], ids=["empty", "text", "other"])
def test_another_file_is_refused(content, tmp_path):
    (tmp_path / "flights").write_bytes(content)
    with pytest.raises(BadInputError, match="use an image of the same version"):
        unpack(tmp_path / "flights")
