# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link VERB`. The modules `cli/link_<verb>.py` contain the verbs."""

from __future__ import annotations

import importlib

from cloudrc.doors.cli.parser import Parser, add_verbs

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
    "relay": "carry TCP connections, or a topic of ROS 2, over the link",
    "run": "shape one direction of the link until SIGTERM",
}
"""Verb -> its line in the help."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    for name, verb in add_verbs(parser, VERBS).items():
        module = importlib.import_module(f"cloudrc.doors.cli.link_{name}")
        verb.epilog = module.EPILOG
        module.arguments(verb)
        verb.set_defaults(execute=module.execute)
