"""`cloudrc identify RUN`: fit a model of the velocity loop for the predictor `command_history`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from math import isnan
from pathlib import Path

from cloudrc.cli.output import format_document, output_argument, print_result
from cloudrc.errors import BadInputError
from cloudrc.files import write_atomically
from cloudrc.runs.requirements import require
from cloudrc.text import escape, table

EPILOG = """\
examples:
  cloudrc run steps --mode virtual
  cloudrc identify runs/latest --out model.yaml
  cloudrc run steps --mode virtual --set cloud.predictor=command_history \\
      --set cloud.predictor.model=model.yaml"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or an MCAP file")
    about = "file for the model (default: model.yaml)"
    parser.add_argument("--out", type=Path, default=Path("model.yaml"), metavar="FILE", help=about)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Fit the model, write it to a file, and print it."""
    require("identify", ("record",))
    from cloudrc.runs.identify import INPUT, OUTPUT, describe, identify

    out = options.out
    if os.path.lexists(out):
        raise BadInputError(f"{out}: already there; name another file with --out")
    fits, seconds = identify(options.run)
    document = describe(fits, seconds)
    write_atomically(out, f"{format_document(document, 'yaml')}\n".encode())
    head = f"velocity loop from {document['seconds']} s, input {INPUT}, output {OUTPUT}"
    rows: list[Sequence[str]] = [
        ("axis", "time constant [s]", "dead time [s]", "gain", "explained")
    ]
    for name, fit in zip("xyz", fits, strict=True):
        if isnan(fit.share):
            rows.append((name, "stays on the ground", "", "", ""))
            continue
        cells = [f"{v:.3f} ± {h:.3f}" for v, h in zip(*fit[:2], strict=True)]
        rows.append((name, *cells, f"{fit.share:.1%}"))
    shown = table(rows, right=(1, 2, 3, 4))
    text = f"{head}\n\n{shown}\n\n± : 95 % interval\n{escape(str(out))}"
    print_result(options.output, document, text)
    return 0
