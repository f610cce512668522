"""The model's distributions of jitter in the form that tc-netem takes: one file of integers each.

netem draws an entry of a table of up to 16,384 and multiplies it by the jitter; 8192 stands for 1,
and 16 bits end at 4. tc's own tables are not ours (see `fates.shape`), and it has none for the
uniform distribution, without which a qdisc cannot go back to uniform once it had another.

Source: iproute2 netem/README.distribution, Linux, net/sched/sch_netem.c (tabledist).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from hashlib import blake2b
from math import ceil, sqrt
from pathlib import Path
from statistics import NormalDist, fmean

from cloudrc.link.fates import PARETO_CUT
from cloudrc.link.profile import DirectionProfile

ENTRIES = 4096
STRETCH = {"uniform": 1, "normal": 1, "pareto": 4}
"""How many times smaller than the jitter a table's entries are, so that its tail fits in 16 bits;
the jitter that tc is given has to be as many times larger."""

_ONE = 8192
_END = 32_767 / _ONE
"""Largest entry in units of the jitter: 16 bits."""


def _pareto(share: float) -> float:
    survival: float = PARETO_CUT + (1.0 - PARETO_CUT) * (1.0 - share)
    return float(survival ** (-1 / 3))


_QUANTILES: dict[str, Callable[[float], float]] = {
    "uniform": lambda share: 2.0 * share - 1.0,
    "normal": NormalDist().inv_cdf,
    "pareto": _pareto,
}


def table(distribution: str) -> list[int]:
    """Make the table of a distribution: its quantiles in the middle of 4096 equal shares.

    Args:
        distribution: "uniform", in (-1, 1); "normal" or "pareto", mean 0 and standard deviation 1.

    Returns:
        Entries in units of jitter / (8192 STRETCH), rising, shape (4096,).
    """
    quantile = _QUANTILES[distribution]
    values = [quantile((index + 0.5) / ENTRIES) for index in range(ENTRIES)]
    if distribution != "uniform":
        mean = fmean(values)
        deviation = sqrt(fmean([(value - mean) ** 2 for value in values]))
        values = [(value - mean) / deviation for value in values]
    return [round(value * _ONE / STRETCH[distribution]) for value in values]


def stretch(profile: DirectionProfile) -> int:
    """Say by what the jitter that tc is given is larger than a profile's, as in `STRETCH`."""
    if profile.distribution != "table":
        return STRETCH[profile.distribution]
    return ceil(max(map(abs, profile.table)) / _END) or 1


def distribution_name(profile: DirectionProfile) -> str:
    """Name a profile's distribution for tc: one of `STRETCH`, or that of a measured table."""
    if profile.distribution != "table":
        return profile.distribution
    # Letters and digits: tc makes a file's name of it. Another table is another file.
    return "table" + blake2b(repr(profile.table).encode(), digest_size=8).hexdigest()


def write_tables(folder: Path) -> None:
    """Write all tables as tc finds them when the environment's TC_LIB_DIR names this folder."""
    for distribution in STRETCH:
        _write(folder, distribution, table(distribution))


def write_measured(folder: Path, profile: DirectionProfile) -> None:
    """Write the table of a profile whose distribution was measured; else do nothing."""
    if profile.distribution == "table":
        unit, values = _ONE / stretch(profile), sorted(profile.table)
        picked = [values[(2 * i + 1) * len(values) // (2 * ENTRIES)] for i in range(ENTRIES)]
        _write(folder, distribution_name(profile), [round(value * unit) for value in picked])


def _write(folder: Path, name: str, entries: Iterable[int]) -> None:
    listed = list(entries)
    rows = [listed[start : start + 8] for start in range(0, ENTRIES, 8)]
    text = "\n".join(" ".join(map(str, row)) for row in rows)
    (folder / f"{name}.dist").write_text(f"# {name}\n{text}\n")
