"""The model's distributions of jitter in the form that tc-netem takes: one file of integers each.

netem draws an entry of a table of up to 16,384 and multiplies it by the jitter; 8192 stands for 1,
and 16 bits end at 4. tc's own tables are not ours (see `fates.shape`), and it has none for the
uniform distribution, without which a qdisc cannot go back to uniform once it had another.

Source: iproute2 netem/README.distribution, linux net/sched/sch_netem.c (tabledist).
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt
from pathlib import Path
from statistics import NormalDist, fmean

from cloudrc.link.fates import PARETO_CUT

ENTRIES = 4096
STRETCH = {"uniform": 1, "normal": 1, "pareto": 4}
"""How many times smaller than the jitter a table's entries are, so that its tail fits in 16 bits;
the jitter that tc is given has to be as many times larger."""

_ONE = 8192


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


def write_tables(folder: Path) -> None:
    """Write all tables as tc finds them when the environment's TC_LIB_DIR names this folder."""
    for distribution in STRETCH:
        entries = table(distribution)
        rows = [entries[start : start + 8] for start in range(0, ENTRIES, 8)]
        text = "\n".join(" ".join(map(str, row)) for row in rows)
        (folder / f"{distribution}.dist").write_text(f"# {distribution}\n{text}\n")
