"""The time that cloud computes: files for `cloud.compute_ms`, and cores that robots share."""

from __future__ import annotations

from pathlib import Path

from cloudrc.config.problems import problem_at
from cloudrc.config.schema import Cloud
from cloudrc.errors import BadInputError
from cloudrc.link.traces import read_lines
from cloudrc.outside.reuse import reuse
from cloudrc.outside.values import InvalidValueError, Quantity

_TIME = Quantity("ms", 0, 100_000)


def compute_times(given: float | str) -> tuple[float, ...]:
    """Return the computing times of `cloud.compute_ms` [ms]: one, or all lines of a file.

    Lines that are empty or begin with # do not count. Raise a BadInputError if the file is invalid.
    """
    return (given,) if isinstance(given, float) else reuse(("compute", given), lambda: _read(given))


def check_unshared(cloud: Cloud) -> None:
    """Check, for robots that fly in real time, that their clouds share no emulated cores."""
    if cloud.cores and cloud.compute_ms:
        text = "robots share them in virtual time only; use --mode virtual, or cloud.cores=null"
        raise problem_at("cloud.cores", text)


def _read(path: str) -> tuple[float, ...]:
    found, remedy = list[float](), "give a file with a time in ms in each line"
    for number, line in enumerate(read_lines(Path(path), f"compute_ms {path}", remedy), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            found.append(_TIME.read(line.strip()))
        except InvalidValueError as error:
            raise BadInputError(f"{path}:{number}: {error}; {remedy}") from error
    if not any(found):
        raise BadInputError(f"{path}: has no time above 0; {remedy}")
    return tuple(found)
