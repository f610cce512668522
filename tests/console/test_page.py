"""The console in a browser, on a session of real processes."""

import io
import subprocess
import sys
import threading
import time
import urllib.request

import numpy as np
import pytest
from PIL import Image

from cloudrc.cli import extras
from cloudrc.cli.client import Api
from cloudrc.cli.main import main
from cloudrc.drivers.local import under_way

LIMIT = 120.0
"""Time limit for what has no number of its own [s]: a browser without a graphics card is slow."""


def start(folder, *words):
    command = [sys.executable, "-m", "cloudrc", *map(str, words)]
    kinds = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=folder, **kinds)


def wait_for(condition, limit=LIMIT):
    """Return how long it takes until the condition holds [s]."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < limit
        time.sleep(0.02)
    return time.monotonic() - began


@pytest.fixture
def flight(tmp_path):
    """A session with the hover's scene: the API, the console's address, and the run's folder."""
    session = start(tmp_path, "up", "hover", "--set", "link.profile=wifi")
    wait_for(lambda: under_way() or session.poll() is not None)
    ((run, url),) = under_way().items()
    api = Api(url)
    wait_for(lambda: (tmp_path / "runs").exists() and answers(api))
    console = start(tmp_path, "console", run)
    address = console.stdout.readline().split()[-1]
    yield api, address, run
    session.terminate()
    assert console.wait(LIMIT) == 0, "it ends with the run"
    session.communicate(timeout=LIMIT)
    console.stdout.close()


def answers(api):
    try:
        return api.get("/v1/state")["seen"]
    except Exception:
        return False


def button(page, name):
    return page.get_by_role("button", name=name, exact=True)


@pytest.fixture
def page(browse, flight):
    opened = browse(f"{flight[1]}/?fixedDpr=0.5")
    opened.set_default_timeout(LIMIT * 1e3)
    button(opened, "STOP").wait_for()
    return opened


def z_arrow(page):
    """Return the middle of the gizmo's blue arrow on the page [px]."""
    for _ in range(20):  # the scene appears slowly
        picture = Image.open(io.BytesIO(page.screenshot(timeout=LIMIT * 1e3))).convert("RGB")
        red, green, blue = np.moveaxis(np.asarray(picture, dtype=int)[:, 350:930], -1, 0)
        rows, columns = np.nonzero((blue > 200) & (red < 100) & (blue - green > 60))
        if len(rows) > 20:
            return float(np.median(columns)) + 350, float(np.median(rows))
        page.wait_for_timeout(500)
    raise AssertionError("no gizmo")


@pytest.mark.process
def test_drag_and_send_moves_the_setpoint(flight, page):
    api, address, run = flight
    numbers = page.get_by_role("textbox")

    def target():
        return [float(numbers.nth(axis).input_value()) for axis in range(3)]

    before, (x, y) = target(), z_arrow(page)
    page.mouse.move(x, y)
    page.mouse.down()
    for up in (20, 40):
        page.mouse.move(x, y - up)
        page.wait_for_timeout(300)
    page.mouse.up()
    wait_for(lambda: target() != before)
    button(page, "Send").click()
    wait_for(lambda: api.get("/v1/missions")["missions"])
    (mission,) = api.get("/v1/missions")["missions"]
    assert api.get(f"/v1/missions/{mission['id']}")["route_m"] == [target()]
    other = start(run, "console", run)
    assert address in other.communicate(timeout=LIMIT)[0]
    assert other.returncode == 2


@pytest.mark.process
def test_keys_drive_and_sliders_change_the_delay(flight, page, figure):
    api, _, _ = flight
    page.keyboard.down("KeyW")
    wait_for(lambda: api.get("/v1/state")["seen"]["position_m"][2] > 0.5)
    page.keyboard.up("KeyW")
    mission = api.get("/v1/state")["mission"]
    assert mission["name"] == "drive"
    page.get_by_role("tab", name="Link").click()
    page.get_by_role("textbox").first.fill("150")  # the uplink's delay
    page.keyboard.press("Enter")
    took = wait_for(lambda: api.get("/v1/state")["seen"]["rtt_s"] > 0.15)
    figure("slider to measured delay", took, "<=", 2.0, "s")


@pytest.mark.process
def test_the_second_browser_reads_and_stop_works_under_load(browse, flight, page, figure):
    api, address, _ = flight
    api.post("/v1/goto", {"position_m": (0.0, 0.0, 0.8)})
    second = browse(f"{address}/?fixedDpr=0.5")
    second.get_by_text("Read only").wait_for(timeout=LIMIT * 1e3)
    assert button(second, "STOP").count() == 0
    over = threading.Event()

    def load():
        while not over.is_set():
            urllib.request.urlopen(address).read()

    threads = [threading.Thread(target=load) for _ in range(8)]
    for thread in threads:
        thread.start()
    try:
        wait_for(lambda: api.get("/v1/state")["seen"]["guard"] != "GROUND")
        button(page, "STOP").click()
        took = wait_for(lambda: api.get("/v1/state")["seen"]["guard"] == "ESTOP")
    finally:
        over.set()
        for thread in threads:
            thread.join()
    figure("stop under load", took, "<=", 1.0, "s")
    page.close()
    button(second, "STOP").wait_for(timeout=LIMIT * 1e3)


def test_without_the_extra_one_line_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(extras.EXTRAS, "console", ("viser_is_not_here",))
    assert main(["console"]) == 3
    assert "pip install 'cloudrc[console]'" in capsys.readouterr().err


def test_without_a_flight_the_console_says_so(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main(["console"]) == 2
    assert "no run flies here" in capsys.readouterr().err
