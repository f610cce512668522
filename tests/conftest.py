# SPDX-License-Identifier: Apache-2.0

"""Fixtures of all tests: commands, a browser, scenes, sweeps, signals as in a new process."""

import gc
import json
import os
import shutil
import signal
import socket
import time
import traceback
import warnings
from pathlib import Path

import pytest

from cloudrc.base.outside.document import write_yaml
from cloudrc.base.outside.reuse import reuse_results
from cloudrc.config.shipped import file_of
from cloudrc.doors.cli.main import main
from cloudrc.flight.interrupts import forget_interrupt
from tests.support.sweeps import GRID, SHORT

ROOT = Path(__file__).resolve().parents[1]
NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
"""The browser of Debian (`apt-get install chromium`), or that of GitHub's machines."""
# WebGL by the processor: a test machine has no graphics card.
CHROMIUM_FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")

SPAWN = 'name="spawn" pos="0 0 .1"'
"""Spawn of the shipped scenes, as in their files."""

# A shell that starts the tests in the background lets them and their children ignore Ctrl-C, but
# some tests check that a child ends on Ctrl-C.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def nightly(*values):
    """Mark values of a parametrized test as `full`: only `make nightly` tests them."""
    return nightly_rows(*((value,) for value in values))


def nightly_rows(*rows):
    """Mark rows of several values likewise."""
    return [pytest.param(*row, marks=pytest.mark.full) for row in rows]


def _has_ipv6():
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as one:
            one.bind(("::1", 0))
    except OSError:
        return False
    return True


def wait_until(condition, limit=120.0):
    """Wait until `condition()` is true, at most `limit` [s]; return how long it took [s]."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < limit, f"not within {limit:g} s"
        time.sleep(0.01)
    return time.monotonic() - began


def pytest_addoption(parser):
    """Add what the named faults and the search for faults need."""
    group = parser.getgroup("faults")
    about = "fly the schedule of faults in FILE, and no other test"
    group.addoption("--schedule", metavar="FILE", type=Path, help=about)
    about = "seed of the named faults (default: 1)"
    group.addoption("--fault-seed", metavar="N", type=int, default=1, help=about)


def pytest_configure(config):
    """Choose the test that flies the schedule, if there is one; see `pytest_collection_finish`."""
    gc.disable()
    if config.option.schedule is not None:
        config.args[:] = [str(ROOT / "tests" / "faults" / "test_schedule_file.py")]


def pytest_collection_finish():
    """Let the garbage collector skip what is loaded by now: it took a tenth of all time.

    Flights and commands freeze and thaw what there is, and to thaw would end this: so what a flight
    leaves behind stays frozen, too. What is loaded later is visited more rarely than usual.
    """
    gc.collect()
    gc.freeze()
    gc.unfreeze = lambda: None
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


needs_ipv6 = pytest.mark.skipif(not _has_ipv6(), reason="needs the IPv6 address ::1")


def pytest_sessionfinish(session):
    """Fail if tests were skipped and REQUIRE_ALL is set, as in CI; write the reasons to SKIPPED."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    skipped = reporter.stats.get("skipped", []) if reporter else []
    path = os.environ.get("SKIPPED")
    if path and not hasattr(session.config, "workerinput"):  # a worker of xdist counts them, too
        reasons = [report.longrepr[2].removeprefix("Skipped: ") for report in skipped]
        with Path(path).open("a", encoding="utf-8") as file:
            file.writelines(f"{reason}\n" for reason in reasons)
    if skipped and os.environ.get("REQUIRE_ALL"):
        reporter.write_line("REQUIRE_ALL: tests were skipped; see -rs", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give each file to one process, so that what its tests share is flown once.

    With `--dist worksteal`, the tests of a file are flown side by side.
    """
    if config.option.dist == "worksteal":
        return None
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Run a test with the mark `child` in a child process of one thread.

    A signal to a process with several threads may arrive late and elsewhere: then its
    KeyboardInterrupt ends all tests.
    """
    if pyfuncitem.get_closest_marker("child") is None:
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    ours, its = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads
        child = os.fork()
    if not child:
        failed = ""
        try:
            pyfuncitem.obj(**arguments)
        except BaseException:
            failed = traceback.format_exc()
        os.write(its, failed[-60_000:].encode())
        os._exit(bool(failed))
    os.close(its)
    with open(ours, encoding="utf-8") as file:
        failed = file.read()
    status = os.waitpid(child, 0)[1]
    if failed or status:
        pytest.fail(failed or f"the child ended with the status {status}", pytrace=False)
    return True


@pytest.fixture(autouse=True)
def flights_of_others_are_not_seen(request, tmp_path_factory, monkeypatch):
    """Hide runs that the user of this machine flies at the same time."""
    if "e2e" in request.path.parts:
        return  # kind's containers may need XDG_RUNTIME_DIR
    base = tmp_path_factory.getbasetemp()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(base))


@pytest.fixture(autouse=True)
def signals_stay_as_they_were():
    """Restore signal handlers, which a command sets as if it had its own process.

    Under `nohup`, tests and their children would ignore SIGHUP, but some tests need SIGHUP.
    """
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = {number: signal.getsignal(number) for number in numbers}
    if handlers[signal.SIGHUP] is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda number, frame: None)  # the default again in a child
    yield
    for number, handler in handlers.items():
        if signal.getsignal(number) is not handler:
            signal.signal(number, handler)
    forget_interrupt()


@pytest.fixture(scope="module")
def shared_files():
    """Read and check the files of robots and scenes once for a module, as a sweep does.

    No test of the module may change a file that another one flies.
    """
    with reuse_results():
        yield


@pytest.fixture
def call(capsys):
    """Return a function that runs a command, checks its exit code, and returns its output."""

    def run(line, *more, code=0):
        capsys.readouterr()
        assert main([*line.split(), *map(str, more)]) == code
        return capsys.readouterr()

    return run


@pytest.fixture
def as_json(call):
    """Return a function that runs a command with `-o json`, and returns the document."""
    return lambda line, *more, code=0: json.loads(call(f"{line} -o json", *more, code=code).out)


@pytest.fixture
def refused(call):
    """Return a function that runs a command and returns its only output: one line of error."""

    def run(line, *more, code=2):
        out, error = call(line, *more, code=code)
        assert (out, error.count("\n"), error[:16]) == ("", 1, "cloudrc: error: ")
        return error

    return run


@pytest.fixture
def one_core(monkeypatch):
    """Fly in this process, where a test may replace parts of a flight."""
    monkeypatch.setattr("cloudrc.flight.trials.workers.usable_cores", lambda: 1)


@pytest.fixture
def no_page(monkeypatch):
    """Leave out the figures of a report, which take longer than a flight."""

    def draw(folder, *assessment, **wanted):
        (folder / "report.html").write_text("drawn elsewhere")

    monkeypatch.setattr("cloudrc.results.report.write._draw", draw)


@pytest.fixture(scope="session")
def chromium():
    """A headless Chromium, for `browse`; tests that use it carry the mark `process`."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=CHROMIUM_FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def browse(chromium):
    """Open pages: browse(url) returns a page of Playwright, 1280 x 800.

    A `script` runs in the page before its own.
    At the end of the test, no page may have had an error or a request to another server.
    """
    size = {"viewport": {"width": 1280, "height": 800}, "device_scale_factor": 0.5}
    context = chromium.new_context(**size)  # a quarter of the pixels: a processor draws them
    errors, requests, own = [], [], []

    def open_page(url, script=None, **options):
        page = context.new_page()
        if script:
            page.add_init_script(script)
        page.on("console", lambda said: said.type == "error" and errors.append(said.text))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.on("websocket", lambda opened: requests.append(opened.url))
        own.append(url.split("://")[-1].split("/")[0] + "/")
        page.goto(url, **options)
        return page

    yield open_page
    context.close()
    inside = (*own, "data:", "blob:", "about:")
    elsewhere = [url for url in requests if not url.split("://")[-1].startswith(inside)]
    assert not errors
    assert not elsewhere


@pytest.fixture
def scene_with(tmp_path):
    """Return a function that writes the scene `empty` with more bodies, and what follows them."""

    def write(bodies, after=""):
        path = tmp_path / "mine.xml"
        text = file_of("empty").read_text()
        path.write_text(text.replace("</worldbody>", f"{bodies}</worldbody>{after}"))
        return str(path)

    return write


@pytest.fixture
def scene_at(tmp_path):
    """Return a function that writes a shipped scene with its spawn at (x, y, z) [m]."""

    def write(x, y, z, scene="pipes"):
        text = file_of(scene).read_text()
        assert SPAWN in text
        path = tmp_path / f"{scene}_{x}_{y}_{z}.xml"
        path.write_text(text.replace(SPAWN, f'name="spawn" pos="{x} {y} {z}"'))
        return str(path)

    return write


@pytest.fixture
def write_sweep(tmp_path):
    """Return a function that writes the file of a sweep and returns its path."""

    def write(grid=GRID, seeds=1, name="grid.yaml", **keys):
        document = {"experiment": "steps", "set": SHORT, "grid": grid, "seeds": seeds, **keys}
        (tmp_path / name).write_text(write_yaml(document))
        return tmp_path / name

    return write
