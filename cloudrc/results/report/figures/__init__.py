# SPDX-License-Identifier: Apache-2.0

"""Draw the figures of a report, without a display, OpenGL or pyplot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from io import BytesIO
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloudrc.results.record import wall_time
from cloudrc.results.report.figures import budget, curves, flight, marks, still, tails
from cloudrc.results.report.figures.style import Look, Subject

FIGURES: dict[str, tuple[Callable[[Subject], Figure], str, str]] = {
    "flight": (flight.draw, flight.CAPTION, flight.ALT),
    "delay": (curves.draw_delay, curves.DELAY, curves.DELAY_ALT),
    "budget": (budget.draw, budget.CAPTION, budget.ALT),
    "odom": (curves.draw_odom, curves.ODOM, curves.ODOM_ALT),
    "error": (curves.draw_error, curves.ERROR, curves.ERROR_ALT),
    "age": (tails.draw_age, tails.AGE, tails.AGE_ALT),
}
"""Name of a figure -> function that draws the figure, caption, text for readers who cannot see the
figure. The figures of the paper are delay, odom and error."""
PAGE_KINDS, PRINT_KINDS = ("svg",), ("pdf", "png", "svg")
"""Kinds of files: what the page contains, and what the folder figures/ has of each figure."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawn figure."""

    name: str  # name of the files, without suffix
    files: dict[str, bytes]  # kind, such as "svg" -> content
    caption: str
    width: float  # in print [in]
    alt: str  # for readers who cannot see the figure
    # Panels over the whole flight: left, bottom, width and height as shares of the figure.
    over_time: tuple[tuple[float, float, float, float], ...] = ()


def draw_all(subject: Subject, kinds: Iterable[str] = PAGE_KINDS) -> list[Picture]:
    """Draw all figures, each as files of `kinds`.

    Only one thread at a time may draw, because matplotlib's settings are global in a process.
    """
    flown = wall_time(subject.flight.recording.metadata, subject.flight.start_ns or 0)
    pictures = []
    with own_settings(subject.look):
        for name, (draw, caption, alt) in FIGURES.items():
            figure = draw(subject)
            _lay_out(figure)
            files = {kind: save(figure, kind, flown) for kind in kinds}
            panels = _over_time(figure)
            text = caption + (marks.legend(subject) if panels else "")
            pictures.append(Picture(name, files, text, subject.look.width, alt, panels))
    return pictures


def draw_still(subject: Subject) -> Picture:
    """Draw the still picture of a flight, which has a true position."""
    with own_settings(subject.look):
        png = save(still.draw(subject), "png")
    return Picture("still", {"png": png}, still.CAPTION, subject.look.width, still.ALT)


def _lay_out(figure: Figure) -> None:
    """Place the panels once; else each `save` would draw the figure twice to place them."""
    if engine := figure.get_layout_engine():
        engine.execute(figure)
    figure.set_layout_engine(None)


def _over_time(figure: Figure) -> tuple[tuple[float, float, float, float], ...]:
    def is_over_time(axes: Axes) -> bool:
        siblings = axes.get_shared_x_axes().get_siblings(axes)
        return any(sibling.get_xlabel() == curves.TIME for sibling in siblings)

    return tuple(axes.get_position().bounds for axes in figure.axes if is_over_time(axes))


@contextmanager
def own_settings(look: Look) -> Iterator[None]:
    """Let matplotlib use only cloudrc's settings inside the `with` block."""
    with matplotlib.rc_context():
        # matplotlib reads a matplotlibrc in the working folder, which may be somebody else's run.
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(look.settings)
        yield


def save(figure: Figure, kind: str, date: datetime | None = None) -> bytes:
    """Return a figure as a "png", "svg" or "pdf" file; equal figures give equal bytes.

    `date` is stored in the file; with None, the file contains no date.
    """
    target = BytesIO()
    keys = {"svg": "Date", "pdf": "CreationDate", "png": "Creation Time"}
    text = date.isoformat() if date and kind == "png" else date
    about: Any = {keys[kind]: text} if text or kind != "png" else {}
    figure.savefig(target, format=kind, metadata=about)
    return target.getvalue()
