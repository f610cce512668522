"""Run `cloudrc link VERB`. This module has the verb `show` and the arguments of `verify`.

The modules `cli/link_<verb>.py` contain the other verbs. The module of `verify` imports large
packages, which would slow down `cloudrc link --help`.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from cloudrc.cli.cluster_flags import release_arguments
from cloudrc.cli.output import output_argument, print_line
from cloudrc.cli.parser import add_verbs, number, read_seed, settings_from, whole_number
from cloudrc.errors import BadInputError
from cloudrc.files import PICTURES, naming, refuse_other_file
from cloudrc.link.verify import DEFAULT
from cloudrc.runs.requirements import require
from cloudrc.text import escape

EPILOG = """\
examples:
  cloudrc link show satellite
  cloudrc link record runs/latest -o trace.csv
  cloudrc link verify paper-p3
  cloudrc link set downlink.delay_ms=120

All delays are one way. 'cloudrc run --mode local' starts 'cloudrc link run' for
each direction, the chart starts it in each pod: the uplink beside world, the
downlink beside cloud. It watches its profile file and the address of its peer,
and ends on SIGTERM."""
VERBS = {
    "show": "draw a profile and print its delay and loss statistics",
    "record": "turn measured delays into a trace that a profile can replay",
    "verify": "check by measurement that a link does what its profile says",
    "set": "change the link during a flight",
    "exec": "run two programs with the link between them",
    "run": "shape one direction of the link until SIGTERM",
}
"""Verb -> its line in the help."""
SHOW_EPILOG = """\
examples:
  cloudrc link show lossy
  cloudrc link show my.yaml --seconds 120 -o my.svg
  cloudrc link show trace.csv
  cloudrc link show ./my.yaml --packets 300000 --rate 200

The delays come from the same link model as in a flight, packet by packet: a
flight with the same seed has exactly these delays. All delays are one way.
A trace has one packet per row, whatever the duration of the row; a short trace
with losses between 0 and 1 has several."""
VERIFY_EPILOG = """\
examples:
  cloudrc link verify                       the link of the paper's experiment
  cloudrc link verify satellite
  cloudrc link verify paper --set link.uplink.loss=0.05 -o json

The command starts the link's processes on this machine, one per direction, and
sends numbered probes through each. The random numbers of a relay are known, so
the command can predict the delay of each probe; it compares netem with 200
simulated links. Tolerances: max(2 ms, 5 %) of the mean delay, 10 % of the
jitter, max(2 percentage points, 25 %) of the loss. It measures a second time
before it reports that something is off.

With --mode cluster the command judges the link of a release in flight by the
tunnel's own datagrams, within a minute. It reports what it cannot judge.

exit codes: 0 believed, 1 not believed or undecided, 2 bad input,
3 missing prerequisite, 4 no answer in time, 5 cluster, 6 a process died"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    here = {
        "show": (SHOW_EPILOG, show_arguments, show),
        "verify": (VERIFY_EPILOG, verify_arguments, _verify),
    }
    for name, verb in add_verbs(parser, VERBS).items():
        if name in here:
            epilog, declare, act = here[name]
        else:
            module = importlib.import_module(f"cloudrc.cli.link_{name}")
            epilog, declare, act = module.EPILOG, module.arguments, module.execute
        verb.epilog = epilog
        declare(verb)
        verb.set_defaults(act=act)


def execute(options: argparse.Namespace) -> int:
    """Run the verb that the user has chosen, such as `set`; return the exit code."""
    code: int = options.act(options)
    return code


def verify_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `verify`."""
    add = parser.add_argument
    target = f"name of a shipped one, or a file (default: {DEFAULT})"
    add("target", nargs="?", default=DEFAULT, metavar="PROFILE|EXPERIMENT", help=target)
    setting = "override one value of the experiment, for example link.uplink.loss=0.1"
    add("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings", help=setting)
    seconds = (
        "time to send probes (default: as long as needed, at most 120); with --mode cluster: "
        "time to wait for a verdict (default: 270)"
    )
    add("--seconds", type=number(1, 3600, "seconds"), metavar="S", help=seconds)
    shaper = "relay (default), or netem between two network namespaces (needs root)"
    add("--shaper", choices=("relay", "netem"), default="relay", help=shaper)
    mode = "a link started on this machine (default), or the link of a release"
    add("--mode", choices=("local", "cluster"), default="local", help=mode)
    ends = "hosts of a release's two pods, from inside its cluster; used by 'helm test'"
    add("--ends", metavar="WORLD,CLOUD", help=ends)
    release_arguments(parser)
    output_argument(parser)


def _verify(options: argparse.Namespace) -> int:
    from cloudrc.cli.link_verify import execute as verify

    return verify(options)


def show_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `show`."""
    add = parser.add_argument
    add("profile", metavar="PROFILE", help="shipped profile, a file, or a trace in CSV")
    picture = "the picture: .png, .svg or .pdf (default: NAME.png)"
    add("-o", "--output", type=Path, metavar="FILE", help=picture)
    seconds = "time to show (default: 30, or the whole time line)"
    add("--seconds", type=number(0.001, 86_400, "seconds"), metavar="S", help=seconds)
    seed = "seed of the random draws (default: 1)"
    add("--seed", type=read_seed, default=1, metavar="S", help=seed)
    rate = "packets per second (default: 100)"
    add("--rate", type=number(1, 10_000, "Hz"), default=100.0, metavar="HZ", help=rate)
    packets = "packets for the statistics of an unchanging link (default: 100000)"
    add("--packets", type=whole_number(1, 10_000_000), default=100_000, metavar="N", help=packets)


def show(options: argparse.Namespace) -> int:
    """Write a picture of a profile; print statistics and, in the last line, the file's path."""
    require("a picture of a link", ("report",))
    output = options.output or Path(f"{Path(options.profile).stem}.png")
    if output.suffix[1:] not in PICTURES:
        raise BadInputError(f"-o {output}: not a picture; end its name in .png, .svg or .pdf")
    refuse_other_file(output, PICTURES[output.suffix[1:]])
    from cloudrc.cli.progress import Progress

    with closing(Progress(f"reads {options.profile}")) as view:
        title, text, picture = _drawn(options, output.suffix[1:], view.tell)
    with naming(output):
        output.write_bytes(picture)
    print(title)
    print(text)
    print_line(str(output))
    return 0


def _drawn(
    options: argparse.Namespace, kind: str, see: Callable[[str], None]
) -> tuple[str, str, bytes]:
    """Return title, statistics and picture of a profile; `see` gets each step of the work."""
    from cloudrc.report.figures.link import render_link
    from cloudrc.runs.links.sample import SampleSettings, sample_profile, statistics_table

    settings = settings_from(options, SampleSettings)
    about, ways = sample_profile(
        options.profile, settings, lambda text: print_line(f"cloudrc: {text}", sys.stderr), see
    )
    see("draws the picture")
    title = escape(": ".join(filter(None, (Path(options.profile).stem, about))))
    samples = [sample for sample, _ in ways.values()]
    picture = render_link(title, samples[0], samples[1] if samples[1:] else None, kind)
    text = statistics_table({name: numbers for name, (_, numbers) in ways.items()})
    return title, text, picture
