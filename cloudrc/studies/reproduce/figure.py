# SPDX-License-Identifier: Apache-2.0

"""Draw the paper's three figures of one mission as one: delay, position, error."""

from __future__ import annotations

from typing import Any

from cloudrc.results.report.document import Assessment
from cloudrc.results.report.figures import PRINT_KINDS, own_settings, save
from cloudrc.results.report.figures.curves import draw_loop, draw_position, draw_tracking, time_axis
from cloudrc.results.report.figures.style import GREY, new_figure, panel
from cloudrc.results.report.write import subject_of
from cloudrc.studies.reproduce.flights import CHANGES, LINKS

HEIGHT = 6.2
"""Height of the figure [in]."""
ROWS: list[Any] = [["loop"] * 3, ["x", "y", "z"], ["error"] * 3]
"""Panels of the figure, one below the other."""
TITLES = {"loop": "delay", "x": "position", "error": "error"}
"""Panel -> its title."""


def draw(found: Assessment) -> dict[str, bytes]:
    """Draw a mission over all three links; return the figure as PDF, PNG and SVG by suffix."""
    subject = subject_of(found)
    with own_settings(subject.look):
        figure = new_figure(HEIGHT, subject.look.width)
        panels = figure.subplot_mosaic(ROWS)
        for letter, (name, axes) in zip("abcde", panels.items(), strict=True):
            panel(axes, letter, TITLES.get(name, ""))
            if name in "xyz":
                draw_position(axes, subject, "xyz".index(name))
                time_axis(axes, subject)
        draw_loop(panels["loop"], subject)
        draw_tracking(panels["error"], subject)
        panels["z"].legend(loc="lower right")
        begins = (0.0, *(float(subject.flight.seconds(at * 1e9)) for at in CHANGES))
        for begin, link in zip(begins, LINKS, strict=True):
            at = begin + 0.2, panels["loop"].get_ylim()[1]
            panels["loop"].annotate(link, at, color=GREY, va="top")
            for axes in panels.values():
                axes.axvline(begin, color=GREY, lw=0.6, ls=":", zorder=1)
        return {kind: save(figure, kind) for kind in PRINT_KINDS}
