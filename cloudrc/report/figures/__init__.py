"""Draw the figures of a report as PNG and SVG, without a display, OpenGL or pyplot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.report.figures import curves, flight, marks, snapshots
from cloudrc.report.figures.style import RC, Subject

Draw = Callable[[Subject], Figure]
Write = Callable[[Subject], str]
FIGURES: dict[str, tuple[Draw, Write, str]] = {
    "flight": (flight.draw, flight.caption, flight.ALT),
    "delay": (curves.draw_delay, lambda s: curves.DELAY + marks.legend(s), curves.DELAY_ALT),
    "odom": (curves.draw_odom, lambda s: curves.ODOM + marks.legend(s), curves.ODOM_ALT),
    "error": (curves.draw_error, lambda s: curves.ERROR + marks.legend(s), curves.ERROR_ALT),
    "snapshots": (snapshots.draw, lambda s: snapshots.CAPTION, snapshots.ALT),
}
"""Name of a figure -> function that draws the figure, function that returns the caption, text for
readers who cannot see the figure. The figures of the paper are delay, odom and error."""
NAMES = tuple(FIGURES)


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawn figure."""

    name: str  # name of the files, without suffix
    png: bytes
    svg: bytes
    caption: str
    alt: str  # for readers who cannot see the figure
    # Panels over the whole flight: left, bottom, width and height as shares of the figure.
    over_time: tuple[tuple[float, float, float, float], ...] = ()


def draw_all(subject: Subject) -> list[Picture]:
    """Draw all figures.

    Only one thread at a time may draw, because matplotlib's settings are global in a process.
    """
    pictures = []
    with matplotlib.rc_context():
        # matplotlib reads a matplotlibrc in the working folder, which may be somebody else's run.
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(RC)
        for name in NAMES:
            draw, caption, alt = FIGURES[name]
            figure = draw(subject)
            png, svg = save(figure, "png"), save(figure, "svg")
            pictures.append(Picture(name, png, svg, caption(subject), alt, _over_time(figure)))
    return pictures


def _over_time(figure: Figure) -> tuple[tuple[float, float, float, float], ...]:
    def is_over_time(axes: Axes) -> bool:
        siblings = axes.get_shared_x_axes().get_siblings(axes)
        return any(sibling.get_xlabel() == curves.TIME for sibling in siblings)

    return tuple(axes.get_position().bounds for axes in figure.axes if is_over_time(axes))


def save(figure: Figure, kind: str) -> bytes:
    """Return the content of a "png", "svg" or "pdf" file; equal figures give equal bytes."""
    target = BytesIO()
    date = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    figure.savefig(target, format=kind, metadata=date)
    return target.getvalue()
