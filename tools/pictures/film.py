# SPDX-License-Identifier: Apache-2.0

"""Film two flights side by side for the README: the same drone and packets, another predictor.

They are the flights of docs/tutorials/fly-and-steer.md, sections 2 and 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

import cloudrc
from cloudrc.results.metrics.control import ages_at_actuator
from cloudrc.results.report.figures import own_settings
from cloudrc.results.report.figures.style import (
    BLACK,
    DOWNLINK,
    GREEN,
    GREY,
    UPLINK,
    VERMILION,
    Look,
)
from tools.pictures.stage import (
    BLUE,
    GHOST,
    GOAL,
    RED,
    Array,
    Colour,
    Stage,
    View,
    check_size,
    smooth,
)

LINK = "satellite"
TITLES = {
    "last_sample": "last_sample: no prediction",
    "constant_velocity": "constant_velocity: predicts ahead",
}
"""Predictor -> title of its half of the film."""
FASTER, RATE = 2.5, 10.0
"""Seconds of flight in a second of film, and frames per second of film."""
HOLD_MS = 2_500
"""Time for which the last frame stays [ms]."""
QUALITY = 38
"""Of the lossy compression, 0 to 100."""
BYTES_MAX = 2_000_000
"""Largest size of the film: people wait for it, and each version stays in the repository."""
WIDTH, HEIGHT, STRIP, HEAD = 472, 320, 126, 52
"""Sizes of a half [pixels]: width, height of the view, of the curves and of the title."""
GAP = 16
"""Between the halves [pixels]."""
CAMERA = View((0.0, 0.0, 0.0), 4.4, 120.0, -35.0)
CALM = 1.0
"""Standard deviation of the time over which the camera's path is smoothed [s]."""
BETWEEN = 0.15
"""Time between two points of the path that is drawn [s]."""
TOUCH = (*RED[:3], 0.35)
"""Colour of the ball at the place of the touch."""
LEGEND: dict[str, Colour] = {
    "flown path": BLUE,
    "drone, as cloud believes": (*GHOST[:3], 1.0),
    "target": GOAL,
}
"""What the colours of the view mean."""
LONGEST_MS = 1_000.0
"""Upper end of the axis of delays and ages [ms]."""


@dataclass(frozen=True)
class Half:
    """One half of the film: a flight, and its curves with and without their lines."""

    title: str
    result: cloudrc.Result
    drawn: Any  # picture of the curves
    empty: Any  # picture of their axes
    ends: tuple[float, float]  # left and right end of the axes of time [pixels]


def make_film(target: Path) -> None:
    """Fly twice, and write the film as an animated WebP file."""
    results = {
        name: cloudrc.fly("paper", {"link.profile": LINK, "cloud.predictor": name}, seed=1)
        for name in TITLES
    }
    last = max(each.flight.duration for each in results.values())
    halves = [Half(TITLES[name], each, *_curves(each, last)) for name, each in results.items()]
    stage = Stage("pelican", "pipes", (WIDTH, HEIGHT), {"robot": None, "ghost": GHOST})
    stage.open_pipes(CAMERA)
    frames = []
    for now in [*np.arange(0.6, last, FASTER / RATE).tolist(), last]:
        frame = Image.new("RGB", (2 * WIDTH + GAP, HEAD + HEIGHT + STRIP), "white")
        for number, half in enumerate(halves):
            # A flight that has failed stands still from then on.
            here = min(now, _failed_at(half.result))
            frame.paste(_draw(stage, half, here, last), (number * (WIDTH + GAP), 0))
        frames.append(frame)
    times = [round(1e3 / RATE)] * (len(frames) - 1) + [HOLD_MS]
    frames[0].save(
        target,
        save_all=True,
        append_images=frames[1:],
        duration=times,
        loop=0,
        quality=QUALITY,
        method=4,
    )
    check_size(target, BYTES_MAX)


def _draw(stage: Stage, half: Half, now: float, last: float) -> Any:
    """Return one half of the frame at a time of the flight [s]."""
    picture = Image.new("RGB", (WIDTH, HEAD + HEIGHT + STRIP), "white")
    picture.paste(Image.fromarray(_view(stage, half.result, now)), (0, HEAD))
    left, right = half.ends
    here = round(left + (right - left) * min(now, last) / last)
    picture.paste(half.empty, (0, HEAD + HEIGHT))
    picture.paste(half.drawn.crop((0, 0, here, STRIP)), (0, HEAD + HEIGHT))
    pen, font = ImageDraw.Draw(picture), _font(16)
    _explain(pen, now >= _failed_at(half.result))
    pen.text((2, 3), half.title, font=font, fill=BLACK)
    text, colour = _verdict(half.result, now)
    pen.text((2, 26), text, font=font, fill=colour)
    pen.text((WIDTH - 2, 26), f"{now:4.1f} s", font=font, fill=GREY, anchor="ra")
    return picture


def _explain(pen: Any, has_failed: bool) -> None:
    """Write into the view what its colours mean, and that the drone has touched something."""
    font = _font(12)
    left, bottom = 8.0, HEAD + HEIGHT - 12
    pen.rectangle((0, bottom - 10, WIDTH, HEAD + HEIGHT), fill="white")
    for text, colour in LEGEND.items():
        dot = (left, bottom - 4, left + 8, bottom + 4)
        pen.ellipse(dot, fill=tuple(round(255 * part) for part in colour[:3]))
        pen.text((left + 13, bottom), text, font=font, fill=BLACK, anchor="lm")
        left += 13 + pen.textlength(text, font=font) + 16
    if has_failed:
        where = WIDTH / 2, HEAD + 22
        text = "contact: the flight has failed"
        pen.rectangle(pen.textbbox(where, text, font=_font(16), anchor="mm"), fill="white")
        pen.text(where, text, font=_font(16), fill=VERMILION, anchor="mm")


def _font(size: int) -> Any:
    return ImageFont.truetype(f"{mpl.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)


def _failed_at(result: cloudrc.Result) -> float:
    """Return the time of the first failure [s]."""
    return result.failures[0].time if result.failures else np.inf


def _verdict(result: cloudrc.Result, now: float) -> tuple[str, str]:
    """Return what has become of the flight so far, and its colour."""
    if now >= _failed_at(result):
        first = result.failures[0]
        return f"FAILURE: {first.text} at {first.time:.1f} s", VERMILION
    if result.verdict == "success" and now >= result.flight.duration:
        return "SUCCESS: every waypoint reached", GREEN
    return f"flies through three pipes, round trip {result.numbers['rtt_mean']:.1f} s", GREY


def _view(stage: Stage, result: cloudrc.Result, now: float) -> Array:
    """Return the scene at a time of the flight [s]: robot, ghost, setpoint and path."""
    flight = result.flight
    truth, applied = flight.truth, flight.applied
    times, commanded = flight.seconds(truth["stamp_ns"]), flight.seconds(applied["stamp_ns"])
    row = max(int(times.searchsorted(now, "right")) - 1, 0)
    command = max(int(commanded.searchsorted(now, "right")) - 1, 0)
    stage.place("robot", truth["position"][row], truth["orientation_wxyz"][row])
    stage.place("ghost", applied["position"][command], applied["orientation_wxyz"][command])
    step = round(BETWEEN / float(np.median(np.diff(times))))
    path = truth["position"][: row + 1 : step]
    balls = [(applied["setpoint"][command], 0.05, GOAL)]
    if now >= _failed_at(result):
        balls.append((result.failures[0].place, 0.15, TOUCH))
    camera = replace(CAMERA, at=smooth(times, truth["position"], now, CALM))
    return stage.draw(camera, path, [BLUE] * len(path), balls)


def _curves(result: cloudrc.Result, last: float) -> tuple[Any, Any, tuple[float, float]]:
    """Draw delays and ages over time.

    Return the picture, a picture of its axes alone, and the ends of the axis of time [pixels].
    """
    flight, ages = result.flight, ages_at_actuator(result.flight)
    pictures = []
    with own_settings(Look(width=WIDTH / 100, font_size=9.0)):
        for is_drawn in (True, False):
            figure = Figure(figsize=(WIDTH / 100, STRIP / 100), dpi=100)
            axes: Any = figure.add_axes((0.11, 0.32, 0.86, 0.46))
            axes.set(xlim=(0.0, last), ylim=(0.0, LONGEST_MS), xlabel="time (s)", ylabel="ms")
            axes.yaxis.set_ticks([0, 500, 1000])
            figure.text(0.11, 0.87, "uplink delay", color=UPLINK)
            figure.text(0.29, 0.87, "downlink delay", color=DOWNLINK)
            figure.text(0.51, 0.87, "age of what the robot acts on", color=BLACK)
            if is_drawn:
                # Both delays are nearly equal: the downlink is a thin line upon a thick one.
                for name, colour, size in (("uplink", UPLINK, 6.0), ("downlink", DOWNLINK, 1.0)):
                    arrivals = flight.during(f"/{name}_delay")
                    axes.plot(
                        flight.seconds(arrivals["stamp_ns"]),
                        1e3 * arrivals["delay"],
                        ".",
                        ms=size,
                        color=colour,
                    )
                axes.plot(flight.seconds(ages.begin_ns), 1e3 * ages.low, color=BLACK, lw=0.8)
            pictures.append(_as_image(figure))
    left, _, width, _ = axes.get_position().bounds
    return *pictures, (left * WIDTH, (left + width) * WIDTH)


def _as_image(figure: Figure) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
