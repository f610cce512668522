"""The figures: a flight and what was asked for go in, pictures in PNG and SVG come out.

One file draws one figure; it has `draw(subject)`, `caption(subject)` as in a paper, and an `ALT`
text for readers who do not see it. No display, GL or pyplot is needed.
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
"""The figures in the order of the page; the paper's three are delay, odom and error."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure, drawn.

    Attributes:
        name: File name without its suffix.
        png: 200 dpi.
        svg: The same as vectors.
        caption: As in a paper.
        alt: For readers who do not see it.
    """

    name: str
    png: bytes
    svg: bytes
    caption: str
    alt: str


def draw_all(subject: Subject) -> list[Picture]:
    """Draw every figure.

    matplotlib reads its settings from one place of the process: draw in one thread at a time.
    """
    pictures = []
    with matplotlib.rc_context():
        # matplotlib has read a matplotlibrc of the working folder, which may be anybody's run.
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
