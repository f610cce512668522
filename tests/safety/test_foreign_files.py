"""Files from somebody else: cloudrc waits for no pipe, limits sizes, and follows no link."""

import json
import os
import signal
import stat
from contextlib import suppress
from itertools import pairwise
from math import nan
from pathlib import Path

import pytest

from cloudrc import files
from cloudrc.config.load import read_experiment
from cloudrc.config.profile import load_profile
from cloudrc.errors import BadInputError
from cloudrc.files import atomic_file, write_atomically
from cloudrc.link.traces import read_trace
from cloudrc.record.columns import Recording
from cloudrc.record.merge import merge
from cloudrc.record.writer import COUNTS
from cloudrc.report.document import clock_offset_document, write_json
from cloudrc.report.figures import FIGURES
from cloudrc.report.folder import read_run
from cloudrc.report.write import write_report
from cloudrc.runs.grid import read_grid
from tests.metrics.conftest import flown
from tests.record.conftest import cloud_records, rewrite, world_records, write, write_mission


@pytest.fixture(autouse=True)
def no_waiting():
    """End a test that waits for a pipe, and not all tests."""

    def end(number, frame):
        pytest.fail("it waits")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


READERS = (read_experiment, load_profile, read_trace, read_grid, Recording.read)


@pytest.mark.parametrize("read", READERS)
def test_a_pipe_or_device_is_refused_at_once(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    before = os.listdir("/proc/self/fd")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(BadInputError, match=r"^[^\n]*not a file; (give|name) a [^\n]*$"):
            read(path)
    assert len(os.listdir("/proc/self/fd")) == len(before)


def test_what_is_beyond_the_limit_is_refused_and_not_cut(tmp_path):
    """Files of /proc claim to be empty, and so does a file that grows during the read."""
    for size in (0, 1, 99, 100):
        (tmp_path / "a").write_bytes(bytes(size))
        assert files.read(tmp_path / "a", 100) == bytes(size)
    (tmp_path / "a").write_bytes(bytes(101))
    for path in (tmp_path / "a", Path("/proc/self/status")):
        with pytest.raises(files.TooLongError, match="longer than 100 bytes"):
            files.read(path, 100)


@pytest.mark.parametrize("named", ["/dev/zero", "./loop", "~nobody/x.csv", "a\\0/b.py"])
def test_an_unusable_file_in_a_configuration_is_refused(tmp_path, named):
    (tmp_path / "loop").symlink_to("loop")
    for where in ("mission: ", "link: {uplink: {trace: ", "link: {uplink: {table: "):
        (tmp_path / "config.yaml").write_text(f'{where}"{named}"' + "}" * where.count("{"))
        with pytest.raises(BadInputError, match=r"^[^\n]*config\.yaml:1: [^\n]*$"):
            read_experiment(tmp_path / "config.yaml")


def test_nested_aliases_of_yaml_are_limited(tmp_path):
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


def test_facts_in_a_recording_are_used_completely_or_not_at_all(run):
    _, _, anew = read_run(run)
    good = {"mode": "local", "shaper": "netem", "notes": ["seen"]}
    wrong = {"notes": [1]}, {"mode": "elsewhere"}, {"interrupted": {"a": 1}}
    for facts in (
        *(json.dumps(good | changed) for changed in wrong),
        "null",
        '{"mode":',
        "[" * 10**5,
    ):
        write_mission(run / "mission.mcap", *flown().ends(), metadata={"run": facts})
        assert read_run(run)[2] == anew, facts[:99]
    write_mission(run / "mission.mcap", *flown().ends(), metadata={"run": json.dumps(good)})
    assert read_run(run)[2].notes == ("seen",)


@pytest.mark.parametrize("counts", ["[1]", "7", '"x"', "[" * 10**5])
def test_counts_of_others_do_not_matter(run, counts):
    foreign = rewrite(run / "mission.mcap", run / "foreign.mcap", noted={COUNTS: counts})
    assert Recording.read(foreign).note == ""


@pytest.mark.parametrize("uncertainty", ["abc", "1" * 400])
def test_an_offset_of_others_does_not_matter(uncertainty):
    noted = {"clock_offset_method": "packets", "clock_offset_uncertainty_ns": uncertainty}
    assert clock_offset_document(noted) == {"method": "packets"}


def test_a_report_of_others_does_not_matter(run):
    for report in ("null", "[1]", '{"complete":', "[" * 10**5):
        (run / "report.json").write_text(report)
        write_report(run, *read_run(run), page=False)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_undrawable_data_gives_one_line_of_error(run):
    log = flown(lambda seconds: (nan, nan, nan))
    write_mission(run / "mission.mcap", log.ends()[0], ())
    with pytest.raises(BadInputError, match=r"^[^\n]*cannot be drawn \(ValueError: [^\n]*$"):
        write_report(run, *read_run(run))


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


def records(path, name="theirs.mcap"):
    return write(path.with_name(name), world_records(20))


WRITERS = [
    lambda path: write_atomically(path, b"new"),
    lambda path: write_json(path, {}),
    lambda path: Recording.read(records(path)).write(path),
    lambda path: merge(records(path), records(path, "other.mcap")).write(path),
]


@pytest.mark.parametrize("writes", WRITERS)
def test_a_link_is_replaced_and_its_target_kept(theirs, mine, writes):
    path = theirs / "file"
    path.symlink_to(mine)
    writes(path)
    assert mine.read_text() == "mine"
    assert not path.is_symlink()
    assert path.stat().st_size


def test_a_secret_file_has_its_mode_from_the_start(theirs):
    path = theirs / "key"
    path.touch(0o644)
    with atomic_file(path, 0o600) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == 0o600
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_failed_write_leaves_no_trace(theirs):
    write_atomically(theirs / "file", b"old")
    with suppress(KeyboardInterrupt), atomic_file(theirs / "file") as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert os.listdir(theirs) == ["file"]
    assert (theirs / "file").read_bytes() == b"old"


def test_a_report_follows_no_link(theirs, mine, tmp_path, monkeypatch):
    monkeypatch.setattr("cloudrc.report.figures.FIGURES", {"error": FIGURES["error"]})
    (theirs / "config.yaml").write_text("seed: 1")
    write(theirs / "world.mcap", world_records(20))
    write(theirs / "cloud.mcap", cloud_records(20))
    names = ("report.json", "environment.json", "report.html", "mission.mcap", "figures/error.png")
    (theirs / "figures").symlink_to(tmp_path)
    with pytest.raises(BadInputError, match="figures: is a symbolic link; remove it"):
        write_report(theirs, *read_run(theirs), figures=True)
    (theirs / "figures").unlink()
    (theirs / "figures").mkdir()
    for name in names:
        (theirs / name).unlink(missing_ok=True)
        (theirs / name).symlink_to(mine if name != "mission.mcap" else tmp_path / "nothing")
    write_report(theirs, *read_run(theirs), figures=True)
    assert mine.read_text() == "mine"
    assert sorted(os.listdir(tmp_path)) == ["mine", "theirs"]
    assert not any((theirs / name).is_symlink() for name in names)
