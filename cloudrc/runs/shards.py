"""Limit the flights of a sweep, and choose the part (shard) that this job flies."""

from __future__ import annotations

import os
from typing import NamedTuple

from cloudrc.errors import BadInputError

FLIGHTS_MAX = 100_000
"""Default limit of flights: a sweep is a product, and one axis too many is hours of work."""


class JobArray(NamedTuple):
    """The environment variables in which a scheduler numbers the jobs of an array ("": none)."""

    this: str  # number of this job
    all: str = ""  # number of all jobs
    first: str = ""  # number of the first job
    last: str = ""  # number of the last job
    begin: int = 1  # number of the first job, if no variable has it


LSF = JobArray("LSB_JOBINDEX")
ARRAYS = (
    JobArray(
        "SLURM_ARRAY_TASK_ID",
        "SLURM_ARRAY_TASK_COUNT",
        "SLURM_ARRAY_TASK_MIN",
        "SLURM_ARRAY_TASK_MAX",
        begin=0,
    ),
    JobArray("PBS_ARRAY_INDEX"),
    LSF,
    JobArray("JOB_COMPLETION_INDEX", "JOB_COMPLETIONS", begin=0),
)
"""The job arrays of Slurm, PBS, LSF and Kubernetes."""


def read_shard(text: str) -> tuple[int, int]:
    """Parse "I/N": shard I of N shards, counted from 1.

    "auto" reads I and N from the environment variables of a job array, "auto/N" only I.
    """
    index, _, count = text.partition("/")
    if index == "auto":
        return _shard_of_array(count)
    if index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count):
        return int(index), int(count)
    raise BadInputError(f"'{text}' is not I/N with I from 1 to N, or auto")


def _shard_of_array(count: str) -> tuple[int, int]:
    """Return the shard of this job of an array; `count` is the number of shards, if it is given.

    An array that has not all of its jobs, such as the failed jobs alone, is refused: other numbers
    would belong to its jobs, and flights would be left out without a word.
    """
    array = _find_array()
    names = (array.this, array.all, array.first, array.last)
    seen = {name: os.environ[name] for name in names if os.environ.get(name)}
    shown = ", ".join(f"{name}={value}" for name, value in seen.items())
    count = count or seen.get(array.all, "")
    if not count:
        lacks = f"{array.all} is not set" if array.all else "no variable has their number"
        raise BadInputError(f"auto: {shown}, but {lacks}; give auto/N")
    if all(value.isdecimal() for value in [*seen.values(), count]):
        total, first = int(count), int(seen.get(array.first, array.begin))
        last, index = int(seen.get(array.last, first + total - 1)), int(seen[array.this])
        is_whole = int(seen.get(array.all, total)) == total == last - first + 1
        if is_whole and first <= index <= last:
            return index - first + 1, total
    raise BadInputError(
        f"auto: {shown} is no job of an array with all of its {count} jobs; give the shard itself, "
        "such as --shard 7/16, or leave out --shard to fly what is missing"
    )


def _find_array() -> JobArray:
    for array in ARRAYS:
        index = os.environ.get(array.this, "")
        if index and (array, index) != (LSF, "0"):  # LSF gives 0 to a job that is in no array
            return array
    known = ", ".join(array.this for array in ARRAYS)
    if os.environ.get(LSF.this):
        raise BadInputError(
            f"auto: {LSF.this}=0: this LSF job is no array; start it as one, or leave out --shard"
        )
    raise BadInputError(f"auto needs one of {known}; give I/N")
