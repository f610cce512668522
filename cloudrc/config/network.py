"""The network's part of the configuration: a profile and its two directions as frozen objects."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from cloudrc.config.fields import CommandAge, NotNegative, Positive, Section, Share


class GilbertElliott(Section):
    """Loss in bursts: a two-state Markov chain that advances with every packet."""

    bad_start: Share = Field(description="Chance per packet to go from the good to the bad state")
    bad_end: Share = Field(description="Chance per packet to go from the bad to the good state")
    loss_bad: Share = Field(1.0, description="Loss in the bad state")
    loss_good: Share = Field(0.0, description="Loss in the good state")
    delay_bad_ms: NotNegative = Field(0.0, description="Extra delay in the bad state, one way [ms]")

    @model_validator(mode="after")
    def _ends(self) -> GilbertElliott:
        if self.bad_start > 0 and self.bad_end == 0:
            raise ValueError("bad_end must be above 0 where bad_start is: the burst never ends")
        return self


def _kind_of_loss(value: Any) -> str:
    return "<bursts>" if isinstance(value, dict | GilbertElliott) else "<chance>"


Loss = Annotated[
    Annotated[Share, Tag("<chance>")] | Annotated[GilbertElliott, Tag("<bursts>")],
    Discriminator(_kind_of_loss),
]


class Blackout(Section):
    """A time in which nothing passes."""

    start_s: NotNegative = Field(description="Since the link came up [s]")
    duration_s: Positive = Field(description="How long [s]")


class Change(Section):
    """From `at_s` on these values hold; those not named stay as they are."""

    at_s: NotNegative = Field(description="Since the link came up [s]")
    delay_ms: NotNegative | None = Field(None, description="One way [ms]")
    jitter_ms: NotNegative | None = Field(None, description="As in the direction [ms]")
    loss: Loss | None = Field(None, description="Chance, or bursts")
    rate_kbit: Positive | None = Field(None, description="Rate of the bottleneck [kbit/s]")


class Direction(Section):
    """Network conditions of one direction. All delays are ONE WAY."""

    delay_ms: NotNegative = Field(0.0, description="One way [ms]")
    jitter_ms: NotNegative = Field(
        0.0, description="uniform: half width; normal, pareto, table: standard deviation [ms]"
    )
    distribution: Literal["uniform", "normal", "pareto", "table"] = Field(
        "uniform", description="Of the jitter; table: that of the delays in the file `table`"
    )
    table: str | None = Field(
        None, description="CSV file as for trace, whose delays, scaled, are the distribution"
    )
    correlation: Share = Field(0.0, description="Of the jitter of one packet with the next")
    loss: Loss = Field(0.0, description="Chance, or bursts")
    duplicate: Share = Field(0.0, description="Chance that a packet arrives twice")
    reorder: Share = Field(0.0, description="Chance that a packet overtakes: no delay at all")
    corrupt: Share = Field(0.0, description="Chance that one bit of a packet is flipped")
    keep_order: bool = Field(False, description="Packets never overtake each other")
    rate_kbit: Positive | None = Field(None, description="Rate of the bottleneck [kbit/s]")
    queue_packets: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        1000, description="Packets that wait at the bottleneck before the next is dropped"
    )
    changes: tuple[Change, ...] = Field((), description="Time line, rising in at_s")
    trace: str | None = Field(
        None, description="CSV file: time_s,delay_ms[,loss]; relative to the file that names it"
    )
    blackouts: tuple[Blackout, ...] = Field((), description="Times in which nothing passes")

    @model_validator(mode="after")
    def _has_its_table(self) -> Direction:
        if self.distribution == "table" and self.table is None:
            raise ValueError("distribution: table needs the key table: a CSV file of delays")
        return self

    @field_validator("changes")
    @classmethod
    def _rise(cls, changes: tuple[Change, ...]) -> tuple[Change, ...]:
        for index, (before, after) in enumerate(pairwise(changes), start=1):
            if after.at_s <= before.at_s:
                raise ValueError(
                    f"at_s must rise: entry {index} is at {after.at_s:g} s, "
                    f"the one before at {before.at_s:g} s"
                )
        return changes


class Profile(Section):
    """A file under link/profiles."""

    description: str = Field("", description="One line for lists")
    uplink: Direction = Field(Direction(), description="World to cloud")
    downlink: Direction = Field(Direction(), description="Cloud to world")
    command_age_max_ms: CommandAge | None = Field(
        None, description="Command age limit that this link needs [ms]"
    )
