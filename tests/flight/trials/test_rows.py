# SPDX-License-Identifier: Apache-2.0

"""Rows survive a crash, and are read as they were written."""

import json

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.flight.trials.play import run
from cloudrc.flight.trials.rows import Rows, parse_row, read_rows
from tests.support.sweeps import flown

MADE = [{"key": f"k{n}", "point": {}, "seed": n, **flown(x=1.0)} for n in range(3)]


def write(folder, rows, shard=None):
    kept = Rows(folder, shard)
    for row in rows:
        kept.add(row)


def test_half_a_line_is_dropped_and_a_row_is_kept_once(tmp_path):
    write(tmp_path, MADE[:2])
    path = tmp_path / "rows.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    assert list(read_rows(tmp_path)) == ["k0"]
    write(tmp_path, MADE[:2])
    assert path.read_bytes() == whole
    write(tmp_path, MADE[1:], 2)
    assert (tmp_path / "rows-2.jsonl").read_text().count("\n") == 1
    assert list(read_rows(tmp_path).values()) == [MADE[2], *MADE[:2]]


def test_a_line_that_is_no_row_is_named(tmp_path):
    for line in ("{", "[]", "{}", "3", '{"key": "a"}'):
        (tmp_path / "rows-2.jsonl").write_text(f"{json.dumps(MADE[1])}\n{line}\n")
        with pytest.raises(BadInputError, match=r"rows-2.jsonl:2: is not a row"):
            read_rows(tmp_path)
    assert parse_row(json.dumps(MADE[0])) == MADE[0]


class Counted:
    """A trial that counts how often it is played."""

    played = 0

    def __init__(self, number):
        self.key = f"k{number}"

    def play(self):
        Counted.played += 1
        return {**MADE[int(self.key[1:])], "code": CODE}


CODE = ""


def test_only_what_is_missing_is_played(monkeypatch):
    monkeypatch.setattr("cloudrc.base.source.code_hash", lambda: CODE)
    rows, seen = Rows(), []
    rows.add(MADE[1])
    assert run([Counted(n) for n in range(3)], rows, 1, seen.append) is None
    assert ([row["key"] for row in seen], Counted.played) == (["k0", "k2"], 2)
    assert set(rows.kept) == {"k0", "k1", "k2"}
