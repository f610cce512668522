"""Files from somebody else: no waiting for pipes, size limits, errors in one line."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from math import nan
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from cloudrc.cli.main import main
from cloudrc.config import document
from cloudrc.config.load import load_profile, read_experiment
from cloudrc.errors import BadInputError
from cloudrc.files import open_file
from cloudrc.link import traces
from cloudrc.link.traces import read_trace
from cloudrc.messages import UPRIGHT, ZERO, Odometry
from cloudrc.record.reader import read_contents
from cloudrc.records import GroundTruth
from cloudrc.report.folder import read_run
from cloudrc.report.write import write_report
from tests.metrics.conftest import flown
from tests.record.conftest import write_mission


@pytest.fixture(autouse=True)
def no_waiting() -> Iterator[None]:
    """Fail a test that waits for a pipe."""

    def give_up(number: int, frame: FrameType | None) -> None:
        raise TimeoutError("it waits")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


READERS: list[Callable[[Path], object]] = [read_experiment, load_profile, read_trace, read_contents]


@pytest.mark.parametrize("what", ["pipe", "/dev/zero"])
@pytest.mark.parametrize("read", READERS)
def test_a_pipe_or_device_is_refused_at_once(
    tmp_path: Path, read: Callable[[Path], object], what: str
) -> None:
    path = tmp_path / what
    if what == "pipe":
        os.mkfifo(path)
    with pytest.raises(BadInputError, match=r"^[^\n]*not a file; (give|name) a [^\n]*$"):
        read(path)


@pytest.mark.parametrize("key", ["trace", "table"])
@pytest.mark.parametrize("named", ["./pipe", "/dev/zero", "./loop", "~nobody/x.csv", "x" * 300])
def test_one_named_by_a_configuration_is_refused(tmp_path: Path, key: str, named: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    for where in (f"link: {{uplink: {{{key}: '{named}'}}}}", f"mission: ./{named}.yaml"):
        (tmp_path / "config.yaml").write_text(where)
        with pytest.raises(BadInputError, match=r"^[^\n]*config\.yaml:1: [^\n]*$"):
            read_experiment(tmp_path / "config.yaml")


def test_a_path_with_nul_is_refused(tmp_path: Path) -> None:
    for key in ("mission", "cloud: {predictor", "link: {profile", "link: {uplink: {trace"):
        (tmp_path / "c.yaml").write_text(key + ': "a\\0/b.py"' + "}" * key.count("{"))
        with pytest.raises(BadInputError, match=r"c\.yaml:1: text with the character NUL"):
            read_experiment(tmp_path / "c.yaml")


@pytest.mark.parametrize(
    ("module", "read"),
    [(document, read_experiment), (traces, read_trace)],
    ids=["yaml", "csv"],
)
def test_no_file_is_read_beyond_its_size_limit(tmp_path: Path, module: Any, read: Any) -> None:
    path = tmp_path / "long.yaml"
    with path.open("wb") as file:
        file.truncate(module.SIZE_MAX + 1)
    with pytest.raises(BadInputError, match=f": longer than {module.SIZE_MAX} bytes; "):
        read(path)


def test_too_many_values_are_refused(tmp_path: Path) -> None:
    (tmp_path / "many.yaml").write_text(f"name: [{'[],' * 500_000}]")
    with pytest.raises(BadInputError, match="more than 300000 values"):
        read_experiment(tmp_path / "many.yaml")


def test_a_refused_device_is_closed(tmp_path: Path) -> None:
    before = os.listdir("/proc/self/fd")
    with pytest.raises(ValueError, match="not a file"):
        open_file(Path("/dev/null"))
    assert len(os.listdir("/proc/self/fd")) == len(before)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run without a report."""
    (tmp_path / "config.yaml").write_text("name: theirs")
    log = flown()
    records = (sorted(part, key=lambda record: record.stamp_ns) for part in (log.world, log.cloud))
    write_mission(tmp_path / "mission.mcap", *records)
    return tmp_path


GOOD = {"mode": "local", "shaper": "netem", "notes": ["seen"], "records_sha256": "f" * 64}


@pytest.mark.parametrize(
    "before",
    [
        json.dumps(GOOD | wrong)
        for wrong in (
            *({"notes": notes} for notes in ([1], 7, "text", {"a": 1}, None)),
            *({"mode": mode} for mode in (1, "elsewhere", None, ["local"])),
            {"records_sha256": {"a": 1}},
            {"verdict": ["interrupted"]},
        )
    ]
    + ["[" * 100_000, "null", "7", '{"mode":', "\udcff", '["mode"]'],
)
def test_an_old_report_is_used_completely_or_not_at_all(run: Path, before: str) -> None:
    _, _, anew = read_run(run)
    (run / "report.json").write_text(before, errors="surrogateescape")
    assert read_run(run)[2] == anew
    (run / "report.json").write_text(json.dumps(GOOD))
    assert read_run(run)[2].notes == ("seen",)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_undrawable_data_gives_one_line_of_error(run: Path) -> None:
    nowhere = Odometry(1, (nan, nan, nan), UPRIGHT, ZERO, ZERO)
    world = [
        record._replace(odometry=nowhere._replace(stamp_ns=record.stamp_ns))
        if isinstance(record, GroundTruth)
        else record
        for record in flown().world
    ]
    write_mission(run / "mission.mcap", sorted(world, key=lambda each: each.stamp_ns), ())
    with pytest.raises(BadInputError, match=r"^[^\n]*cannot be drawn \(ValueError: [^\n]*$"):
        write_report(run, *read_run(run))
    assert json.loads((run / "report.json").read_text())["verdict"] == "failure"


def test_a_report_does_not_wait_for_pipes(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cloudrc.report.write._write_page", lambda *words: None)
    os.mkfifo(run / "pipe")
    for name in ("config.yaml", "mission.mcap"):
        kept = (run / name).read_bytes()
        (run / name).unlink()
        os.mkfifo(run / name)
        (run / "world.mcap").write_bytes(b"")
        assert main(["report", str(run)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("cloudrc: error: ")
        (run / name).unlink()
        (run / name).write_bytes(kept)
