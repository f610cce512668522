# SPDX-License-Identifier: Apache-2.0

"""The command `cloudrc`: help, errors in one line, exit codes, broken pipes."""

import subprocess
import sys
from io import BytesIO, TextIOWrapper
from unittest.mock import Mock

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.doors.cli import link, link_relay, process
from cloudrc.doors.cli.main import INTERNAL, main
from cloudrc.doors.cli.parser import COMMANDS, GROUPS
from cloudrc.doors.new import NEW
from tests.support.commands import python

HEAVY = ("numpy", "mujoco", "matplotlib", "pydantic", "yaml", "kubernetes", "rosbags", "mcap")
QUIET = f"""
import sys
from cloudrc.doors.cli.main import main
for line in sys.argv[1:]:
    try:
        main(line.split())
    except SystemExit:
        pass
print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)
"""


def test_help_imports_nothing_heavy():
    lines = ["--help", *(f"{name} --help" for name in COMMANDS)]
    assert python("-c", QUIET, *lines).stderr.strip() == "[]"


def test_the_list_names_all_onboard_controllers_without_numpy_or_physics():
    done = python("-c", QUIET, "list")
    assert done.stderr.strip() == "['yaml']"
    (section,) = [each for each in done.stdout.split("\n\n") if each.startswith("onboard\n")]
    names = [line.split()[0] for line in section.splitlines()[1:]]
    assert names == ["diff_drive", "multirotor", "pelican/onboard.py"]


VERBS = {"link": link.VERBS, "link relay": link_relay.VERBS, "process": process.VERBS, "new": NEW}


@pytest.mark.parametrize(
    "command", ["", *COMMANDS, *(f"{name} {verb}" for name in VERBS for verb in VERBS[name])]
)
def test_help_fits_80_columns(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([*command.split(), "--help"])
    text = capsys.readouterr().out
    assert end.value.code == 0
    assert max(map(len, text.splitlines())) <= 80
    if not command:
        listed = {line.split()[0] for line in text.splitlines() if line.startswith("  ")}
        assert COMMANDS.keys() - listed == {"process"}, "which the chart and a flight type"
        assert len(COMMANDS) <= 31
        assert list(GROUPS)[:4] == ["fly and steer", "links", "studies", "policies"]
        assert main([]) == 0, "no argument prints help, too"
        assert capsys.readouterr().out == text


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("rnu", "did you mean run?"),
        ("world --config x.yaml", "no choice named 'world'"),
        ("process wrld", "did you mean world?"),
        ("link show --sed 3", "--sed; did you mean --seed?; see 'cloudrc link show --help'"),
        ("bench --repeats 0", "'0' is not a whole number >= 1 and <= 10000"),
    ],
)
def test_a_wrong_command_line_is_one_line_of_error(line, words, refused):
    assert words in refused(line)


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (BadInputError("key x"), 2, "key x"),
        (PermissionError(13, "Not allowed", "/x"), 2, "/x: Not allowed; check path"),
        (OSError(24, "Too many open files"), 3, "Too many open files; raise 'ulimit -n'"),
        (RuntimeError("Could not allocate memory"), 3, "memory ran out (RuntimeError: Could not"),
        (ZeroDivisionError("two\nlines"), INTERNAL, "ZeroDivisionError: two lines"),
    ],
)
def test_an_error_prints_one_line_and_sets_its_exit_code(error, code, words, monkeypatch, refused):
    monkeypatch.setattr("cloudrc.doors.cli.list.execute", Mock(side_effect=error))
    assert words in refused("list", code=code)
    with pytest.raises(type(error)):
        main(["list", "--debug"])


def test_an_interrupt_ends_with_130_in_silence(monkeypatch, call):
    monkeypatch.setattr("cloudrc.doors.cli.list.execute", Mock(side_effect=KeyboardInterrupt))
    assert call("list", code=130) == ("", "")


def test_a_closed_pipe_is_no_error():
    line = f"{sys.executable} -m cloudrc list -o json | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("0\n", "")


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [("ascii", "3 +- 1 ? 2"), ("iso8859-2", "3 +- 1 ? 2"), ("utf-8", "3 ± 1 € 2")],
)
def test_an_output_without_a_sign_gets_a_substitute(encoding, shown, monkeypatch):
    stream = TextIOWrapper(BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr("cloudrc.doors.cli.list.execute", lambda options: print("3 ± 1 € 2"))
    assert main(["list"]) == 0
    assert stream.buffer.getvalue().decode(encoding) == f"{shown}\n"


def test_a_closed_output_is_no_error():
    line = f"{sys.executable} -m cloudrc list -o json >&-; {sys.executable} -m cloudrc list >&-"
    done = subprocess.run(["bash", "-ec", line], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_plugin_of_kubectl_calls_itself_as_it_is_typed(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["/usr/local/bin/kubectl-cloudrc"])
    with pytest.raises(SystemExit):
        main(["mission", "--help"])
    assert capsys.readouterr().out.startswith("usage: kubectl cloudrc mission")
