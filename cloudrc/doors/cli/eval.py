# SPDX-License-Identifier: Apache-2.0

"""`cloudrc eval`: measure whether a policy survives a network."""

from __future__ import annotations

import shlex
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import CloudrcError
from cloudrc.base.outside.paths import lock_folder
from cloudrc.base.outside.refusal import naming
from cloudrc.base.requirements import require
from cloudrc.base.text import cells, csv_table, escape, latex_table
from cloudrc.doors.cli.output import TABLES, again, output_argument, print_result, tell
from cloudrc.doors.cli.parser import COUNT_MAX, Options, Parser, number, read_count, whole_number
from cloudrc.flight.folder import new_folder

if TYPE_CHECKING:
    from cloudrc.flight.trials.rows import Row
    from cloudrc.studies.eval.results import Before
    from cloudrc.studies.eval.setup import Episode, EvalSetup

EPILOG = """\
examples:
  cloudrc eval --env CartPole-v1 --policy ./law.py --rtt 0,80 --success-at 500
  cloudrc eval --env Pendulum-v1 --policy ws://gpu:8000 --link lte --seeds 50
  cloudrc eval --env metaworld:Meta-World/MT1 --env-arg env_name=reach-v3 \\
      --env-arg seed={seed} --policy ./expert.py --link lte --rtt 0,80

law.py has a function infer(observation), as for 'cloudrc policy serve'. The
environment and its packages are yours. Each condition has the same seeds. With
--out DIR of an earlier call, only missing episodes are played, and those whose
files have changed."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = "environment of gymnasium: its id, MODULE:ID or ./FILE.py:ID"
    parser.add_argument("--env", required=True, metavar="ID", help=about)
    about = "argument of the environment; repeatable"
    parser.add_argument("--env-arg", action="append", default=[], metavar="KEY=VALUE", help=about)
    about = "a Python file, or the address of a server (ws://...)"
    parser.add_argument("--policy", required=True, metavar="POLICY", help=about)
    _execution_arguments(parser)
    _episode_arguments(parser)
    about = "size of an observation on the wire (default: that of its arrays)"
    parser.add_argument("--observation-bytes", type=whole_number(0, 10**9), metavar="N", help=about)
    about = "how images travel: jpeg, jpeg:QUALITY, h264 or h264:KBIT (default: as they are)"
    parser.add_argument("--codec", metavar="CODEC", help=about)
    about = "what of a message arrives (default: stream for a server, else datagrams)"
    parser.add_argument("--delivery", choices=("datagrams", "stream"), help=about)
    about = "most bytes of a packet; what is larger is several packets (default: 1200)"
    parser.add_argument(
        "--packet-bytes", type=whole_number(1, 10**9), default=1200, metavar="N", help=about
    )
    about = "parallel processes for a policy in a file (default: one per core)"
    parser.add_argument("--jobs", type=read_count, default=COUNT_MAX, metavar="N", help=about)
    about = "folder (default: a new one in runs/); if it has rows, play the others"
    parser.add_argument("--out", type=Path, metavar="DIR", help=about)
    about = "also write a line per episode into this file: .csv or .parquet"
    parser.add_argument("--rows", type=Path, metavar="FILE", help=about)
    about = "folder of another policy's evaluation, to compare with in pairs"
    parser.add_argument("--versus", type=Path, metavar="DIR", help=about)
    about = (
        "keep a file per episode that is played, in the folder timelines; read it with"
        " 'cloudrc timeline'"
    )
    parser.add_argument("--keep", choices=("timeline",), help=about)
    output_argument(parser, forms=TABLES)


def _execution_arguments(parser: Parser) -> None:
    """Declare what is between policy and environment, and what the policy observes of it."""
    about = "link profile, a name or a file (default: ideal)"
    parser.add_argument("--link", default="ideal", metavar="PROFILE", help=about)
    about = "mean round trips in ms, such as 0,40,80 (default: the profile's)"
    parser.add_argument("--rtt", type=_round_trips, default=(None,), metavar="MS,...", help=about)
    about = "ways to execute answers, such as newest,prefix (default: newest)"
    parser.add_argument("--executor", default="newest", metavar="NAME,...", help=about)
    about = "parameters of the executors, such as share=.5"
    parser.add_argument(
        "--set", action="append", nargs="+", default=[], metavar="KEY=VALUE", help=about
    )
    about = "time for an answer in s: a number, MEAN,DEVIATION, a file, 'measured' (default: 0)"
    parser.add_argument("--compute", default="0", metavar="TIME", help=about)
    about = "how long the robot waits in a step for an answer, in s (default: 5 %% of it)"
    parser.add_argument("--answer-within", type=number(0, 3600, "seconds"), metavar="S", help=about)
    about = "action before the first answer; 'none': 0; 'answer': the robot waits for it (default)"
    parser.add_argument("--start", default="answer", metavar="ACTION", help=about)
    about = "without an action, the robot repeats its last or executes that of --start"
    parser.add_argument("--hold", choices=("repeat", "start"), default="repeat", help=about)
    about = "the policy observes the age of its observation, too"
    parser.add_argument("--observe-age", action="store_true", help=about)
    about = "how many of its own last actions the policy observes, too (default: 0)"
    parser.add_argument(
        "--observe-actions", type=whole_number(0, 1000), default=0, metavar="N", help=about
    )
    about = "the policy observes the step of its observation, too"
    parser.add_argument("--observe-step", action="store_true", help=about)


def _episode_arguments(parser: Parser) -> None:
    about = "seeds 1 to N of each condition (default: 20)"
    parser.add_argument("--seeds", type=read_count, default=20, metavar="N", help=about)
    about = "file from the environment's observation to the policy's (YAML)"
    parser.add_argument("--map", type=Path, metavar="FILE", help=about)
    about = "smallest return of a success (default: what the info says)"
    parser.add_argument(
        "--success-at", type=number(-1e30, 1e30, "reward"), metavar="RETURN", help=about
    )
    about = "time of a step in s, if the environment does not tell it"
    parser.add_argument("--dt", type=number(1e-6, 3600, "seconds"), metavar="S", help=about)
    about = "longest episode in steps (default: 10000)"
    parser.add_argument("--max-steps", type=read_count, default=10_000, metavar="N", help=about)
    about = "robots that play an episode together, with --channel (default: 1)"
    parser.add_argument("--robots", type=read_count, default=1, metavar="N", help=about)
    about = "file of the channel that they share: slot_ms, per_slot, schedule (YAML)"
    parser.add_argument("--channel", type=Path, metavar="FILE", help=about)
    about = "largest age of an observation behind an action, in s; older: late"
    parser.add_argument("--deadline", type=number(1e-6, 3600, "seconds"), metavar="S", help=about)


def _round_trips(text: str) -> tuple[float, ...]:
    read = number(0, 60_000, "ms")
    return tuple(sorted({read(each.strip()) for each in text.split(",")}))


def execute(options: Options) -> int:
    """Play what is missing, write the report, and print the table."""
    require("an evaluation", ["gym", "report", *(["policy"] if "://" in options.policy else [])])
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.eval import results
    from cloudrc.studies.eval.episode import check_environment
    from cloudrc.studies.eval.setup import BASELINE, Episode

    setup, episodes = _read(options)
    folder = options.out
    goes_on = folder is not None and results.is_begun(folder)
    if goes_on:
        with naming(f"--out {folder}"):
            results.check_folder(folder, setup)
    with Progress(f"makes the environment {setup.env}"):
        setup, doubts = check_environment(setup, episodes)
    doubts += [f"--env {setup.env}: {results.SEEDLESS}"] * (not setup.follows_seed)
    for text in doubts:
        tell(f"warning: {text}")
    episodes = [*(Episode(None, BASELINE, n + 1) for n in range(options.seeds)), *episodes]
    known = results.read_before(folder, setup) if goes_on else results.Before()
    known, before = _versus(options, known, setup, episodes)
    if not goes_on:
        folder = new_folder(folder, f"eval-{Path(setup.env).name}", "latest-eval")
    with lock_folder(folder):
        with Progress("plays episodes", len(episodes)) as view:
            view.say(f"{setup.env}: {len(episodes)} episodes, {setup.facts}")
            try:
                asked = folder, setup, episodes, options.jobs, known, view.count
                rows, stopped = results.play_missing(*asked, keep=bool(options.keep))
            except CloudrcError:
                tell(f"what was played is kept; the same call with --out {folder} goes on")
                raise
        if stopped:
            tell(f"{stopped}; {again(options.out, folder)}")
            return stopped.exit_code
        if options.rows:
            results.write_rows(options.rows, rows)
        try:
            with Progress("draws the page"):
                document, page = _report(options, setup, folder, rows, before, known)
        except KeyboardInterrupt:
            tell(f"interrupted; {again(options.out, folder)}")
            raise
    rows = document["outcomes"]
    tables = {"csv": csv_table(rows), "latex": latex_table(cells(rows, results.COLUMNS))}
    text = f"{results.as_text(document)}\n{escape(str(page))}"
    print_result(options.output, document, text, **tables)
    return 0


def _versus(
    options: Options, known: Before, setup: EvalSetup, episodes: list[Episode]
) -> tuple[Before, list[Row]]:
    """Return what the folder has to know, and the rows of the policy to compare with.

    Without --versus, the comparison of an earlier call stays, if its folder still fits.
    """
    from cloudrc.studies.eval.results import read_versus

    given = options.versus or known.versus
    seeds = tuple(dict.fromkeys([*known.seeds, options.seeds]))
    try:
        with naming(f"--versus {given}"):
            rows = read_versus(Path(given), setup, episodes) if given else []
    except CloudrcError as error:
        if options.versus:
            raise
        tell(f"warning: the comparison of an earlier call is left out: {error}")
        given, rows = "", []
    return known._replace(versus=str(given), seeds=seeds), rows


def _report(
    options: Options,
    setup: EvalSetup,
    folder: Path,
    rows: list[Row],
    before: list[Row],
    known: Before,
) -> tuple[dict[str, Any], Path]:
    """Judge the rows; write and return the file of the evaluation, and the path of its page."""
    from cloudrc.studies.eval import results
    from cloudrc.studies.eval.evidence import judge
    from cloudrc.studies.eval.link_schedule import describe_met, find_met
    from cloudrc.studies.eval.page import write_page
    from cloudrc.studies.eval.provenance import provenance

    found = judge(rows, before, *known) | known._asdict()
    for outcome in found["outcomes"][1:]:
        mean = outcome.get("observation_bytes")  # with a codec, sizes differ
        outcome |= (setup if mean is None else replace(setup, sent_bytes=round(mean))).sent
    found["time_line"] = met = find_met(setup, rows)
    found["notes"] += describe_met(met) if met else []
    found["success"] = results.describe_success(setup, found["outcomes"])
    found |= provenance(setup, shlex.join(["cloudrc", *options.given]))
    document = results.write(folder, setup, found)
    return document, write_page(folder, setup, document)


def _read(options: Options) -> tuple[EvalSetup, list[Episode]]:
    """Check the flags; return the evaluation and its episodes."""
    from cloudrc.doors.cli import eval_values as values
    from cloudrc.studies.eval.setup import Episode, EvalSetup

    executors = list(dict.fromkeys(each.strip() for each in options.executor.split(",")))
    setup = EvalSetup(
        options.env,
        options.policy,
        values.read_env_args(options.env_arg),
        options.link,
        *values.read_compute(options.compute),
        values.read_mapped(options.map),
        options.success_at,
        options.dt,
        options.max_steps,
        options.observation_bytes,
        options.answer_within,
        deadline=options.deadline,
        delivery=options.delivery or ("stream" if "://" in options.policy else "datagrams"),
        packet_bytes=options.packet_bytes,
        start=values.read_start(options.start),
        hold=options.hold,
        observe_age=options.observe_age,
        observe_actions=options.observe_actions,
        observe_step=options.observe_step,
        robots=options.robots,
        channel=values.read_channel(options.channel, options.robots),
        codec=values.read_codec(options.codec, options.observation_bytes),
    )
    values.check_policy(setup.policy)
    values.check_rows(options.rows)
    values.check_round_trips(setup.link, options.rtt)
    given = values.read_parameters([*chain(*options.set)], executors)
    episodes = [
        Episode(rtt, executor, seed, given[executor])
        for executor in executors
        for rtt in options.rtt
        for seed in range(1, options.seeds + 1)
    ]
    return setup, episodes
