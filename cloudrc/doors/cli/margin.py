# SPDX-License-Identifier: Apache-2.0

"""`cloudrc margin KEY`: up to which value of KEY is the loop stable, and do flights succeed?"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.base.text import escape
from cloudrc.doors.cli.compare import flight_arguments
from cloudrc.doors.cli.output import output_argument, print_result, warn_of_few_seeds
from cloudrc.doors.cli.parser import Options, Parser, number

if TYPE_CHECKING:
    from cloudrc.studies.margin import Answer, Margin

EPILOG = """\
examples:
  cloudrc margin link.both.delay_ms
  cloudrc margin link.both.delay_ms --set cloud.predictor=last_sample --seeds 6
  cloudrc margin guard.command_age_max_ms --max 500
  cloudrc margin link.uplink.loss --resolution 0.05 -o json

Two answers. The loop is stable if the response to a step of 0.1 m per axis dies
out, in the scene 'empty': this is small-signal, the delay margin of the linear
loop. It settles in time if the flights of the experiment succeed with all
seeds. The search begins at the present value and goes up and down. It raises
cloud.horizon_max_s, cloud.freeze_after_s and guard.command_age_max_ms as the
delays need it, unless --set gives them."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("key", metavar="KEY", help="key of the experiment whose value is a number")
    flight_arguments(parser, seeds=3)
    above_0 = number(1e-9, 1e12, "units")
    about = "largest value to try (default: 32 times the first, which is the present one)"
    parser.add_argument("--max", type=above_0, metavar="X", help=about)
    about = "try multiples of R (default: 10 for a key in ms, 1 for whole numbers, else 0.01)"
    parser.add_argument("--resolution", type=above_0, metavar="R", help=about)
    output_argument(parser)


def execute(options: Options) -> int:
    """Print both answers; return 0, or 1 if no value is stable (or, without that, none settles)."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.margin import Asked, Margin, as_text, describe

    asked = options.key, options.experiment, options.set, options.seeds
    margin = Margin(Asked(*asked, options.max, options.resolution))
    present, _ = margin.experiment(margin.present)
    assert present is not None, "the search begins with a value that flies"
    warn_of_few_seeds(options.seeds, present)
    with Progress("flies") as view:
        for name in margin.questions:
            _search(options, margin, name, view.say)
        document = describe(margin)
    lines = as_text(document, margin).splitlines()
    print_result(options.output, document, "\n".join(["", *map(escape, lines)]))
    return 0 if document[f"{margin.questions[0]}_up_to"] is not None else 1


def _search(options: Options, margin: Margin, question: str, say: Callable[[str], None]) -> None:
    """Search the answer to a question, and `say` each value that is tried."""
    from cloudrc.studies.margin import QUESTIONS, why
    from cloudrc.studies.stability import SCENE, SMALL

    facts = {"small": SMALL, "scene": SCENE, "experiment": options.experiment}
    text = QUESTIONS[question].format(**facts)
    say(f"{text}, seeds 1 to {options.seeds}")

    def see(number: int, answer: Answer) -> None:
        say(f"  {margin.name(number):<26}{why(question, answer)}")

    margin.search(question, see)
