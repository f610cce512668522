"""Files from somebody else: no waiting for pipes, size limits, no link is followed."""

import json
import os
import signal
import stat
from contextlib import suppress
from itertools import pairwise
from math import nan
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.config import document
from cloudrc.config.load import load_profile, read_experiment
from cloudrc.errors import BadInputError
from cloudrc.faults.schedule import Schedule, dump
from cloudrc.files import atomic_file, open_file, write_atomically
from cloudrc.link import traces
from cloudrc.link.state import publish
from cloudrc.link.traces import read_trace
from cloudrc.record.columns import Recording
from cloudrc.record.merge import merge
from cloudrc.record.reader import read_contents, recover
from cloudrc.report.document import write_json
from cloudrc.report.folder import read_run
from cloudrc.report.write import write_report
from tests.metrics.conftest import flown
from tests.record.conftest import cloud_records, world_records, write, write_mission


@pytest.fixture(autouse=True)
def no_waiting():
    """Fail a test that waits for a pipe."""

    def give_up(number, frame):
        raise TimeoutError("it waits")

    before, mask = signal.signal(signal.SIGALRM, give_up), os.umask(0o022)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
    os.umask(mask)


@pytest.fixture
def pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def test_a_command_refuses_a_pipe_device_or_folder_at_once(pipe, tmp_path, capsys):
    for path in (pipe, Path("/dev/null"), tmp_path):
        assert main(["recover", str(path)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{path}: not a regular file; see 'cloudrc recover --help'" in line
    assert os.listdir(tmp_path) == ["pipe"]


def test_a_redirected_file_is_read(tmp_path):
    """As with `/dev/stdin` and '<'."""
    run = write(tmp_path / "run.mcap", world_records(50))
    with run.open("rb") as handed:
        words = ["recover", f"/dev/fd/{handed.fileno()}", "--to", str(tmp_path / "new.mcap")]
        assert main(words) == 0
    (tmp_path / "schedule.yaml").write_text(dump(Schedule(1, duration=0.5)))
    with (tmp_path / "schedule.yaml").open("rb") as handed:
        assert main(["faults", "run", f"/dev/fd/{handed.fileno()}"]) == 0


@pytest.mark.parametrize("read", [read_experiment, load_profile, read_trace, read_contents])
def test_a_pipe_or_device_is_refused_at_once(tmp_path, pipe, read):
    for path in (pipe, Path("/dev/zero")):
        with pytest.raises(BadInputError, match=r"^[^\n]*not a file; (give|name) a [^\n]*$"):
            read(path)
    before = os.listdir("/proc/self/fd")
    with pytest.raises(ValueError, match="not a file"):
        open_file(Path("/dev/null"))
    assert len(os.listdir("/proc/self/fd")) == len(before)


@pytest.mark.parametrize(
    "named", ["./pipe", "/dev/zero", "./loop", "~nobody/x.csv", "x" * 300, "a\\0/b.py"]
)
@pytest.mark.usefixtures("pipe")
def test_one_named_by_a_configuration_is_refused(tmp_path, named):
    (tmp_path / "loop").symlink_to("loop")
    for where in ("mission: ", "link: {uplink: {trace: ", "link: {uplink: {table: "):
        (tmp_path / "config.yaml").write_text(f'{where}"{named}"' + "}" * where.count("{"))
        with pytest.raises(BadInputError, match=r"^[^\n]*config\.yaml:1: [^\n]*$"):
            read_experiment(tmp_path / "config.yaml")


@pytest.mark.parametrize(("module", "read"), [(document, read_experiment), (traces, read_trace)])
def test_no_file_is_read_beyond_its_size_limit(tmp_path, module, read):
    path = tmp_path / "long.yaml"
    with path.open("wb") as file:
        file.truncate(module.SIZE_MAX + 1)
    with pytest.raises(BadInputError, match=f": longer than {module.SIZE_MAX} bytes; "):
        read(path)


def test_aliases_in_aliases_do_not_multiply_values_without_end(tmp_path):
    names = "abcdefghij"
    lines = [f"{y}: &{y} [{', '.join(f'*{x}' for _ in names)}]" for x, y in pairwise(names)]
    (tmp_path / "config.yaml").write_text("\n".join(["a: &a [1]", *lines]))
    with pytest.raises(BadInputError, match="more than 300000 values"):
        read_experiment(tmp_path / "config.yaml")


@pytest.fixture
def run(tmp_path):
    """A run without a report."""
    (tmp_path / "config.yaml").write_text("name: theirs")
    write_mission(tmp_path / "mission.mcap", *flown().ends())
    return tmp_path


GOOD = {"mode": "local", "shaper": "netem", "notes": ["seen"], "records_sha256": "f" * 64}
WRONG = [
    *({"notes": notes} for notes in ([1], 7, "text", None)),
    *({"mode": mode} for mode in (1, "elsewhere", ["local"])),
    *({"records_sha256": {"a": 1}}, {"verdict": ["interrupted"]}),
]


def test_an_old_report_is_used_completely_or_not_at_all(run):
    _, _, anew = read_run(run)
    broken = ["[" * 100_000, "null", '{"mode":', "\udcff", '["mode"]']
    for before in (*(json.dumps(GOOD | wrong) for wrong in WRONG), *broken):
        (run / "report.json").write_text(before, errors="surrogateescape")
        assert read_run(run)[2] == anew, before[:99]
    (run / "report.json").write_text(json.dumps(GOOD))
    assert read_run(run)[2].notes == ("seen",)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_undrawable_data_gives_one_line_of_error(run):
    log = flown(lambda seconds: (nan, nan, nan))
    write_mission(run / "mission.mcap", log.ends()[0], ())
    with pytest.raises(BadInputError, match=r"^[^\n]*cannot be drawn \(ValueError: [^\n]*$"):
        write_report(run, *read_run(run))
    assert json.loads((run / "report.json").read_text())["verdict"] == "failure"


# Links.


@pytest.fixture
def mine(tmp_path):
    """A file of the user that must not change."""
    path = tmp_path / "mine"
    path.write_text("mine")
    return path


@pytest.fixture
def theirs(tmp_path):
    """A folder from somebody else."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    return folder


def merged(path):
    ends = (write(path.with_name(f"{n}.mcap"), world_records(20)) for n in range(2))
    merge(*ends).write(path)


WRITERS = [
    lambda path: write_atomically(path, b"new"),
    lambda path: publish(path, "new"),
    lambda path: write_json(path, {}),
    lambda path: recover(write(path.with_name("torn.mcap"), world_records(20)), path),
    merged,
]


@pytest.mark.parametrize("writes", WRITERS)
def test_a_link_is_replaced_and_its_target_kept(theirs, mine, monkeypatch, writes):
    path = theirs / "file"
    path.symlink_to(mine)
    writes(path)
    assert mine.read_text() == "mine"
    assert not path.is_symlink()
    assert path.stat().st_size
    # Even a link with the name of the temporary file is refused, not followed.
    monkeypatch.setattr(os, "urandom", lambda size: b"\xab" * 8)
    (theirs / f".file.{'ab' * 8}").symlink_to(mine)
    with pytest.raises(FileExistsError):
        writes(path)
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_a_secret_file_has_its_mode_from_the_start(theirs, mode):
    path = theirs / "key"
    path.touch(0o644)
    with atomic_file(path, mode) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == mode
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert main(["key", "new", str(theirs / "new")]) == 0
    assert stat.S_IMODE((theirs / "new").stat().st_mode) == 0o600


def test_a_failed_write_leaves_no_trace(theirs):
    write_atomically(theirs / "file", b"old")
    with suppress(KeyboardInterrupt), atomic_file(theirs / "file") as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert os.listdir(theirs) == ["file"]
    assert (theirs / "file").read_bytes() == b"old"


def test_recover_refuses_a_broken_link(theirs, capsys):
    torn = write(theirs / "run.mcap", world_records(20))
    (theirs / "run.recovered.mcap").symlink_to(theirs / "nothing")
    assert main(["recover", str(torn)]) == 2
    assert "already there; name another file with --to" in capsys.readouterr().err
    assert not (theirs / "nothing").exists()


def test_a_report_follows_no_link(theirs, mine, tmp_path, monkeypatch):
    monkeypatch.setattr("cloudrc.report.figures.NAMES", ("error",))
    (theirs / "config.yaml").write_text("seed: 1")
    write(theirs / "world.mcap", world_records(20))
    write(theirs / "cloud.mcap", cloud_records(20))
    names = ("report.json", "environment.json", "report.html")
    for name in names:
        (theirs / name).symlink_to(mine)
    (theirs / "mission.mcap").symlink_to(tmp_path / "nothing")
    (theirs / "figures").symlink_to(tmp_path)
    with pytest.raises(BadInputError, match="figures: is a link; remove it"):
        write_report(theirs, *read_run(theirs))
    (theirs / "figures").unlink()
    (theirs / "figures").mkdir()
    (theirs / "figures" / "error.png").symlink_to(mine)
    write_report(theirs, *read_run(theirs))
    assert mine.read_text() == "mine"
    assert sorted(os.listdir(tmp_path)) == ["mine", "theirs"]
    assert not any((theirs / name).is_symlink() for name in (*names, "mission.mcap"))
    assert (theirs / "figures" / "error.png").read_bytes().startswith(b"\x89PNG")
    assert Recording.read(theirs / "mission.mcap").complete
