# SPDX-License-Identifier: Apache-2.0

"""`cloudrc identify RUN`: fit a model of the velocity loop for the predictor `command_history`."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.files import write_atomically
from cloudrc.base.outside.paths import check_new
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import format_document, output_argument, print_result
from cloudrc.doors.cli.parser import Options, Parser

EPILOG = """\
examples:
  cloudrc run steps --mode virtual
  cloudrc identify runs/latest --out model.yaml
  cloudrc run steps --mode virtual --set cloud.predictor=command_history \\
      --set cloud.predictor.model=model.yaml"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or an MCAP file")
    about = "file for the model (default: model.yaml)"
    parser.add_argument("--out", type=Path, default=Path("model.yaml"), metavar="FILE", help=about)
    output_argument(parser)


def execute(options: Options) -> None:
    """Fit the model, write it to a file, and print it."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.identify import as_text, describe, identify

    out = options.out
    check_new(out, "name another file with --out")
    with Progress(f"reads {options.run} and fits the model"):
        found = identify(options.run)
    document = describe(*found)
    write_atomically(out, f"{format_document(document, 'yaml')}\n".encode())
    print_result(options.output, document, f"{as_text(*found)}\n{escape(str(out))}")
