"""A lasting tc process answers like a new tc process, but sooner; here tc is a script."""

import sys

import pytest

from cloudrc.drivers.programs import Programs
from cloudrc.errors import MissingPrerequisiteError

TC = f"""#!{sys.executable}
import sys
from pathlib import Path
log = Path(__file__).with_name("log").open("a")
def answer(words):
    print(*words, file=log, flush=True)
    if "lacks" in words:
        print("Cannot find device eth0", file=sys.stderr, flush=True)
        return 2
    if "show" in words:
        print('[{{"kind":"netem"}}]' if "eth0" in words else "[]", flush=True)
    return 0
if "-batch" not in sys.argv:
    sys.exit(answer(sys.argv[1:]))
for number, line in enumerate(sys.stdin, start=1):
    if line.split()[-1] == "dies":
        break
    if answer(line.split()):
        print(f"Command failed -:{{number}}", file=sys.stderr, flush=True)
"""


CHANGE = ("tc", "qdisc", "change", "dev", "eth0", "netem")
SHOW = ("tc", "-s", "-j", "qdisc", "show", "dev", "eth0")


@pytest.fixture
def programs(tmp_path, monkeypatch):
    program = tmp_path / "tc"
    program.write_text(TC)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    return Programs()


def test_changes_and_lists_go_through_one_process(programs, tmp_path):
    for _ in range(2):
        assert programs((*CHANGE, "delay", "1us")) == ""
        assert programs(SHOW) == '[{"kind":"netem"}]'
        for words in (CHANGE, SHOW):
            with pytest.raises(MissingPrerequisiteError, match="failed: Cannot find device eth0;"):
                programs((*words, "lacks"))
    lines = (tmp_path / "log").read_text().splitlines()
    assert lines[:2] == ["qdisc change dev eth0 netem delay 1us", "qdisc show dev lo"]
    assert lines[2] == "qdisc show dev eth0", "by the same process"
    assert programs((*CHANGE, "dies")) == ""  # repeated in its own process
    assert programs(SHOW) == '[{"kind":"netem"}]'
    programs.close()
    for words, said in (
        ("tc qdisc add lacks", "failed: Cannot"),
        ("no-such", "no program no-such"),
    ):
        with pytest.raises(MissingPrerequisiteError, match=said):
            programs(words.split())
