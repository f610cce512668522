"""`cloudrc doctor`: check whether this machine can fly; print how to fix each problem."""

from __future__ import annotations

import argparse

from cloudrc.cli.output import output_argument, paint, print_result
from cloudrc.errors import MissingPrerequisiteError
from cloudrc.runs.doctor import Survey, all_checks, as_text, blocking
from cloudrc.runs.requirements import MODES


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    about = "the mode to fly in (default: local)"
    add("--mode", choices=MODES, default="local", help=about)
    about = "mode cluster, and survey the cluster: permissions, admission, quota, nodes, images"
    add("--cluster", action="store_true", help=about)
    about = "with --cluster: a value of the chart, as in helm install; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    about = "with --cluster: a file of the chart's values, as in helm install; repeatable"
    add("-f", "--values", action="append", default=[], metavar="FILE", help=about)
    add("--context", metavar="NAME", help="kubeconfig context (default: current)")
    about = "namespace (default: the context's, or default)"
    add("-n", "--namespace", metavar="NAME", help=about)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Print the results of all checks; return 3 if the requested mode cannot run, else 0."""
    if options.cluster:
        options.mode = "cluster"
    values, settings = tuple(options.values), tuple(options.set)
    asked = Survey(options.context, options.namespace, options.cluster, values, settings)
    mode, checks = options.mode, list(all_checks(options.mode, asked))
    lacking = blocking(mode, checks)
    found = [check._asdict() for check in checks]
    document = {"mode": mode, "ready": not lacking, "checks": found}
    print_result(options.output, document, as_text(mode, checks, paint))
    return MissingPrerequisiteError.exit_code if lacking else 0
