# SPDX-License-Identifier: Apache-2.0

"""Pods keep rows in a folder or in a bucket of a real server of S3's API, and find them again."""

import json

import pytest

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.flight.trials import bucket as module
from cloudrc.flight.trials.bucket import open_rows
from cloudrc.flight.trials.plan import PlannedFlight, pack, read_plan
from tests.support.sweeps import flown

MADE = [{"key": f"k{n}", "point": {}, "seed": n, **flown(x=1.0)} for n in range(3)]


@pytest.fixture(scope="module")
def server():
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    yield "http://{}:{}".format(*server.get_host_and_port())
    server.stop()


@pytest.fixture
def bucket(server, monkeypatch):
    from s3fs import S3FileSystem

    monkeypatch.setenv("AWS_ENDPOINT_URL", server)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "b")
    S3FileSystem(skip_instance_cache=True).makedirs("s3://lab", exist_ok=True)
    return "s3://lab"


@pytest.mark.process
def test_rows_of_each_pod_are_objects_of_its_own(bucket, monkeypatch):
    monkeypatch.setattr(module, "PART", 2)
    first = open_rows(f"{bucket}/one/", "1-aa")
    for row in MADE:
        first.add(row)
    second = open_rows(f"{bucket}/one", "1-bb")
    assert second.kept == first.kept
    second.add(MADE[0])
    second.add({**MADE[0], "key": "new"})
    from s3fs import S3FileSystem

    store = S3FileSystem(skip_instance_cache=True)
    names = ["rows-1-aa-0.jsonl", "rows-1-aa-1.jsonl", "rows-1-bb-0.jsonl"]
    assert [path.rpartition("/")[2] for path in store.ls("lab/one")] == names
    sizes = [store.cat(f"lab/one/{name}").count(b"\n") for name in names]
    assert sizes == [2, 1, 1]
    assert open_rows(f"{bucket}/other", "1-aa").kept == {}


@pytest.mark.process
def test_an_error_of_the_bucket_names_it_and_what_to_check(bucket, monkeypatch):
    with pytest.raises(MissingPrerequisiteError, match=r"s3://missing/one: .*; check the bucket"):
        open_rows("s3://missing/one", "1")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    with pytest.raises(MissingPrerequisiteError, match="Could not connect"):
        open_rows("s3://lab/one", "1")


@pytest.mark.parametrize("kind", ["folder", pytest.param("bucket", marks=pytest.mark.process)])
def test_a_pod_flies_what_no_pod_before_has_kept(
    kind, request, tmp_path, write_sweep, monkeypatch, call
):
    """A killed pod leaves half of the rows of its shard; the next pod prints them all."""
    place = request.getfixturevalue("bucket") if kind == "bucket" else str(tmp_path)
    begun = []

    def play(flight):
        begun.append(flight.key)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return flight.row(flown())

    monkeypatch.setattr(PlannedFlight, "play", play)
    flights = read_plan(write_sweep()).flights
    (tmp_path / "flights").write_bytes(pack(flights.values()))
    line = f"sweep rows {tmp_path}/flights --shard 1/1 --out {place}/kept"
    call(line, code=130)
    printed = [json.loads(line)["key"] for line in call(line).out.splitlines()]
    assert printed == [*flights]
    assert begun == [*flights][:2] + [*flights][1:]
