# SPDX-License-Identifier: Apache-2.0

"""Draw the figure of `cloudrc link show`: delay and loss over time, distribution of the delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.config.profile import DirectionConfig
from cloudrc.results.metrics.flight import Array
from cloudrc.results.report.figures import marks, own_settings, save, style
from cloudrc.results.report.figures.style import Look, dots, legend_above, new_figure, panel

BLACKOUT = "#f7dccb"
"""Colour of blackouts: the colour of losses, but lighter."""
DOTS = 6000
"""Approximate limit of the number of dots in a panel; more dots would hide each other."""
LEAST = 1e-4
"""Lower end of the axis of shares [1]."""


@dataclass(frozen=True, slots=True)
class DirectionSample:
    """Simulated packets of one direction of a link, for the figure of `cloudrc link show`."""

    name: str  # "uplink" or "downlink"; "one way" for a trace
    asked: DirectionConfig  # the link profile
    sent: Array  # time of sending each packet, since the start of the link [s], shape (n,)
    delays: Array  # one-way delays, NaN for lost packets [s], shape (n,)
    many: Array  # one-way delays for the distribution, NaN for lost packets [s], shape (m,)

    @property
    def colour(self) -> str:
        """Colour of the direction."""
        return style.DOWNLINK if self.name == "downlink" else style.UPLINK


def render_link(title: str, ways: Sequence[DirectionSample], kind: str) -> bytes:
    """Draw the directions of a link; return the content of a file of `kind` "png", "svg", "pdf"."""
    with own_settings(Look()):
        return save(_draw(title, ways), kind)


def _draw(title: str, ways: Sequence[DirectionSample]) -> Figure:
    figure = new_figure(4.4)
    figure.suptitle(title, x=0.01, ha="left", fontsize=9.5)
    mosaic: list[Any] = [[way.name for way in ways], ["distribution"] * len(ways)]
    axes = figure.subplot_mosaic(mosaic)
    for letter, (name, each) in zip("abc", axes.items(), strict=False):
        panel(each, letter, name)
    top = 1.12 * max(1.0, *(np.nanmax(way.delays, initial=0.0) * 1e3 for way in ways))
    for way in ways:
        _draw_delay(axes[way.name], way, top)
    _draw_tail(axes["distribution"], ways)
    return figure


def _draw_delay(axes: Axes, way: DirectionSample, top: float) -> None:
    """Draw the profile's delays as a band, packets as dots, lost packets at the lower edge.

    `top` is the upper end of the delay axis [ms].
    """
    duration = float(way.sent[-1]) if len(way.sent) else 1.0
    delays = marks.delays_of(way.asked)
    if delays is not None and (way.asked.trace is None or way.asked.jitter_ms):
        time = np.linspace(0.0, duration, 2000)
        low, high = marks.band(
            delays, time, marks.radio_span(way.asked, uplink=way.name != "downlink")
        )
        axes.fill_between(time, low, high, color=style.LIGHT, lw=0, zorder=1, label="profile")
    _draw_blackouts(axes, way, duration)
    thin = slice(None, None, max(1, len(way.sent) // DOTS))
    dots(axes, way.sent[thin], way.delays[thin] * 1e3, way.colour, "packet")
    lost = way.sent[np.isnan(way.delays)]
    if len(lost):
        look: dict[str, Any] = {"marker": "|", "ls": "none", "color": style.VERMILION}
        axes.plot(lost, np.full(len(lost), -0.045 * top), ms=4.0, mew=0.5, label="lost", **look)
    axes.set_xlim(0.0, duration)
    axes.set_ylim(-0.09 * top, top)
    axes.set_xlabel("time since the link started (s)")
    axes.set_ylabel("one-way delay (ms)")
    legend_above(axes)


def _draw_blackouts(axes: Axes, way: DirectionSample, duration: float) -> None:
    """Draw the blackouts that begin within the `duration` of the axis [s]."""
    shown = [blackout for blackout in way.asked.blackouts if blackout.start_s < duration]
    for index, blackout in enumerate(shown):  # draw a short blackout as wide as a line
        end = blackout.start_s + max(blackout.duration_s, duration / 300)
        label = "_" if index else "blackout"
        axes.axvspan(blackout.start_s, end, color=BLACKOUT, lw=0, zorder=1.5, label=label)


def _draw_tail(axes: Axes, ways: Sequence[DirectionSample]) -> None:
    """Plot, for each delay, the share of packets with a longer delay, on a logarithmic axis."""
    for way, dashes in zip(ways, ("-", "--"), strict=False):
        delays = way.many[np.isfinite(way.many)] * 1e3
        if len(delays):
            look: dict[str, Any] = {"color": way.colour, "ls": dashes, "label": way.name}
            axes.ecdf(delays, complementary=True, rasterized=True, **look)
    axes.set_yscale("log")
    axes.set_ylim(LEAST, 1.3)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("one-way delay (ms)")
    axes.set_ylabel("share with more delay")
    legend_above(axes)
