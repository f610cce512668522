"""Draw the figure of `cloudrc link show`: delay and loss over time, distribution of the delay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.config.profile import DirectionConfig
from cloudrc.metrics.flight import Array
from cloudrc.report.figures import marks, own_settings, save, style
from cloudrc.report.figures.style import Look, dots, legend_above, new_figure, panel

BLACKOUT = "#f7dccb"
"""Colour of blackouts: the colour of losses, but lighter."""
DOTS = 6000
"""Approximate limit of the number of dots in a panel; more dots would hide each other."""


@dataclass(frozen=True, slots=True)
class DirectionSample:
    """Simulated packets of one direction of a link, for the figure of `cloudrc link show`."""

    asked: DirectionConfig  # the link profile
    sent: Array  # time of sending each packet, since the start of the link [s], shape (n,)
    delays: Array  # one-way delays, NaN for lost packets [s], shape (n,)
    many: Array  # one-way delays for the distribution, NaN for lost packets [s], shape (m,)


_LabelledWay: TypeAlias = tuple[DirectionSample, str, str]
"""A direction of the link, its name and its colour."""


def render_link(
    title: str, uplink: DirectionSample, downlink: DirectionSample | None, kind: str
) -> bytes:
    """Draw the figure of a link; return the content of a file of `kind` "png", "svg" or "pdf".

    `downlink` is None for a trace, which has one direction only.
    """
    with own_settings(Look()):
        return save(_draw(title, uplink, downlink), kind)


def _draw(title: str, uplink: DirectionSample, downlink: DirectionSample | None) -> Figure:
    figure = new_figure(4.4)
    figure.suptitle(title, x=0.01, ha="left", fontsize=9.5)
    ways: list[_LabelledWay] = [(uplink, "uplink" if downlink else "one way", style.UPLINK)]
    if downlink:
        ways.append((downlink, "downlink", style.DOWNLINK))
    largest = [np.nanmax(way.delays, initial=0.0) * 1e3 for way, _, _ in ways]
    top = 1.12 * max(*largest, 1.0)
    grid = figure.add_gridspec(2, 2)
    for place, (way, name, colour) in enumerate(ways):
        axes = figure.add_subplot(grid[0, place] if downlink else grid[0, :])
        panel(axes, "ab"[place], name)
        _draw_delay(axes, way, colour, top)
    _draw_tail(figure.add_subplot(grid[1, :]), "bc"[len(ways) - 1], ways)
    return figure


def _draw_delay(axes: Axes, way: DirectionSample, colour: str, top: float) -> None:
    """Draw the profile's delays as a band, packets as dots, lost packets at the lower edge.

    `top` is the upper end of the delay axis [ms].
    """
    duration = float(way.sent[-1]) if len(way.sent) else 1.0
    delays = marks.delays_of(way.asked)
    if delays is not None and (way.asked.trace is None or way.asked.jitter_ms):
        time = np.linspace(0.0, duration, 2000)
        low, high = (1e3 * bound for bound in marks.band(delays, time))
        axes.fill_between(time, low, high, color=style.LIGHT, lw=0, zorder=1, label="profile")
    _draw_blackouts(axes, way, duration)
    thin = slice(None, None, max(1, len(way.sent) // DOTS))
    dots(axes, way.sent[thin], way.delays[thin] * 1e3, colour, "packet")
    lost = way.sent[np.isnan(way.delays)]
    if len(lost):
        bottom = np.full(len(lost), -0.045 * top)
        look: dict[str, Any] = {"marker": "|", "ls": "none", "color": style.VERMILION}
        axes.plot(lost, bottom, ms=4.0, mew=0.5, clip_on=False, zorder=3, **look)
        axes.plot([], [], ms=5.0, mew=1.0, label="lost", **look)
    axes.set_xlim(0.0, duration)
    axes.set_ylim((-0.09 if len(lost) else -0.02) * top, top)
    axes.set_xlabel("time since the link started (s)")
    axes.set_ylabel("one-way delay (ms)")
    legend_above(axes, 4)


def _draw_blackouts(axes: Axes, way: DirectionSample, duration: float) -> None:
    """Draw the blackouts that begin within the `duration` of the axis [s]."""
    shown = [blackout for blackout in way.asked.blackouts if blackout.start_s < duration]
    for index, blackout in enumerate(shown):  # draw a short blackout as wide as a line
        end = blackout.start_s + max(blackout.duration_s, duration / 300)
        label = "_" if index else "blackout"
        axes.axvspan(blackout.start_s, end, color=BLACKOUT, lw=0, zorder=1.5, label=label)


def _draw_tail(axes: Axes, letter: str, ways: list[_LabelledWay]) -> None:
    """Plot, for each delay, the share of packets with a longer delay, on a logarithmic axis."""
    panel(axes, letter, "distribution")
    least = 1e-2
    for (way, name, colour), dashes in zip(ways, ("-", "--"), strict=False):
        delays = way.many[np.isfinite(way.many)] * 1e3
        if not len(delays):
            continue
        least = min(least, 1.0 / len(delays))
        shares = np.concatenate([np.linspace(1.0, 0.1, 500), np.geomspace(0.1, least, 500)])
        label = name if len(ways) == 2 else "_"
        axes.plot(np.quantile(delays, 1.0 - shares), shares, color=colour, ls=dashes, label=label)
    axes.set_yscale("log")
    axes.set_ylim(max(least, 1e-4) / 1.3, 1.3)
    for level, name in ((0.5, "median"), (0.01, "99 %")):
        axes.axhline(level, color=style.GREY, lw=0.6, ls=(0, (1, 2)), zorder=1)
        text = axes.text(0.995, level * 1.12, name, transform=axes.get_yaxis_transform())
        text.set(color=style.GREY, fontsize=7.5, ha="right", va="bottom")
    right = max(axes.get_xlim()[1], 1.0)
    axes.set_xlim(-0.005 * right, right)
    axes.set_xlabel("one-way delay (ms)")
    axes.set_ylabel("share with more delay")
    legend_above(axes, 4)
