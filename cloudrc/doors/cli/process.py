# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc process NAME`: one process of a flight. Modules `process_<name>.py` contain them."""

from __future__ import annotations

import importlib

from cloudrc.doors.cli.parser import Parser, add_verbs

VERBS = {
    "world": "the robot: physics, sensors, guard, onboard controller",
    "cloud": "the remote controller",
    "teleop": "missions and the operator's HTTP API",
    "cell": "the radio cell that all robots of a fleet share",
}
"""Name of a process -> its line in the help."""
EPILOG = """\
A flight in real time starts these processes here, the chart starts them in its
pods. Each ends on SIGTERM. 'cloudrc link run' is the process of the link."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    for name, verb in add_verbs(parser, VERBS).items():
        module = importlib.import_module(f"cloudrc.doors.cli.process_{name}")
        verb.epilog = module.EPILOG
        module.arguments(verb)
        verb.set_defaults(execute=module.execute)
