# SPDX-License-Identifier: Apache-2.0

"""`cloudrc see RUN`: what does a perception make of the pictures or scans of a recorded flight?"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import output_argument, print_result
from cloudrc.doors.cli.parser import Options, Parser

if TYPE_CHECKING:
    from cloudrc.doors.second_look import SecondLook
    from cloudrc.wire.messages import Vector

EPILOG = """\
examples:
  cloudrc see runs/latest --perception mine.py
  cloudrc see runs/latest -o json                 its own perception once more

The recording of the experiment follow has its pictures; others have them with
--set camera.keep=true. Scans are always there. A time is that since the
mission's start at which a picture or scan was taken. The odometry is the newest
of that time; cloud may have had an older one, so that a perception which uses
velocities can differ from its own flight by millimetres."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or an MCAP file")
    about = "name or file of a perception (default: that of the flight)"
    parser.add_argument("--perception", metavar="FILE", help=about)
    output_argument(parser)


def execute(options: Options) -> None:
    """Print a line for each picture or scan, and what they have in common."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.doors.second_look import look_again, summarize

    with Progress(f"reads the recording of {options.run}"):
        try:
            looks = look_again(options.run, options.perception)
        except InvalidValueError as error:
            raise BadInputError(str(error)) from None
    summary = summarize(looks)
    document = {"summary": summary, "looks": [_as_json(each) for each in looks]}
    print_result(options.output, document, "\n".join(_lines(looks, summary)))


def _as_json(look: SecondLook) -> dict[str, Any]:
    made = look.setpoint
    return {
        "time_s": look.time,
        "setpoint_m": made and made.position,
        "yaw_rad": made.yaw if made is not None and made.turns else None,
        "flown_m": look.flown,
        "error": look.error,
    }


def _lines(looks: Iterable[SecondLook], summary: dict[str, Any]) -> Iterable[str]:
    yield f"{'time':>8}  {'setpoint [m]':22}  {'in the flight [m]':22}  apart"
    for look in looks:
        made = _place(None if look.setpoint is None else look.setpoint.position)
        apart = f"{look.apart:.3f} m" if look.apart == look.apart else ""
        why = escape(look.error)
        yield f"{look.time:8.3f}  {made:22}  {_place(look.flown):22}  {apart}{why}".rstrip()
    mean, most = summary["apart_mean_m"], summary["apart_max_m"]
    apart = "" if mean is None else f"; {mean:.3f} m apart on average, {most:.3f} m at most"
    yield (
        f"\n{summary['seen']} seen, {summary['setpoints']} setpoints, "
        f"{summary['setpoints_flown']} in the flight{apart}; "
        f"{summary['failed']} failed"
    )


def _place(place: Vector | None) -> str:
    return "-" if place is None else " ".join(f"{value:7.3f}" for value in place)
