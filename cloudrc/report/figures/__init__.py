"""Draw the figures of a report as PNG and SVG.

Each module draws one figure. A module has `draw(subject)`, `caption(subject)`, and the text `ALT`
for readers who cannot see the figure. No module needs a display, GL or pyplot.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from io import BytesIO

import matplotlib
from matplotlib.figure import Figure

from cloudrc.report.figures.style import RC, Subject

__all__ = ["NAMES", "Picture", "Subject", "draw_all"]

NAMES = ("flight", "delay", "odom", "error", "snapshots")
"""Figures in the order of the page; the paper has the figures delay, odom and error."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawn figure.

    Attributes:
        name: File name without suffix.
        png: Content of the PNG file, 200 dpi.
        svg: Content of the SVG file.
        caption: Caption, as in a paper.
        alt: Description for readers who cannot see the figure.
    """

    name: str
    png: bytes
    svg: bytes
    caption: str
    alt: str


def draw_all(subject: Subject) -> list[Picture]:
    """Draw every figure.

    The settings of matplotlib are global in the process: only one thread at a time may draw.
    """
    pictures = []
    with matplotlib.rc_context():
        # matplotlib reads a matplotlibrc in the working folder, which may be somebody else's run.
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(RC)
        for name in NAMES:
            drawing = importlib.import_module(f"{__name__}.{name}")
            figure = drawing.draw(subject)
            png, svg = _saved(figure, "png"), _saved(figure, "svg")
            pictures.append(Picture(name, png, svg, drawing.caption(subject), drawing.ALT))
    return pictures


def _saved(figure: Figure, kind: str) -> bytes:
    target = BytesIO()
    # Without a date, and with a hash salt in RC, the same flight gives the same bytes.
    figure.savefig(target, format=kind, metadata={"Date": None} if kind == "svg" else None)
    return target.getvalue()
