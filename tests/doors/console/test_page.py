# SPDX-License-Identifier: Apache-2.0

"""The console in a browser, on a session of real processes."""

import io
import time
from contextlib import ExitStack
from math import nan

import numpy as np
import pytest
from PIL import Image

from cloudrc.config.load import load_experiment
from cloudrc.doors.console.controls import KEYS, Controls
from cloudrc.doors.console.feed import FlightFeed
from cloudrc.doors.console.page import PANEL_WIDTH, Page
from cloudrc.doors.console.steering import Steering
from cloudrc.flight.links.change import read_states
from cloudrc.flight.local.places import LINK_FOLDER
from tests.conftest import wait_until
from tests.doors.console.conftest import (
    LIMIT,
    acknowledge,
    answers,
    beside,
    in_pod,
    session_with_console,
    start,
    status,
)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session with the hover's scene: the API, the console's address, and the run's folder."""
    with session_with_console(tmp_path_factory) as (api, run, console):
        address, opened = (console.stdout.readline().split()[-1] for _ in range(2))
        assert opened == address
        yield api, address, run


@pytest.fixture
def flight(session):
    """The session, whose robot is at the spawn and has no mission."""
    api = session[0]
    if seen(api)["guard"] == "ESTOP":
        acknowledge(api)
    elif mission := mission_of(api):
        api.post(f"/v1/missions/{mission['id']}/cancel")
    wait_until(lambda: not mission_of(api) and answers(api)["guard"] != "ESTOP")
    mission = api.post("/v1/missions", {"waypoints": [{"position_m": (0.0, 0.0, 0.6)}]})
    wait_until(lambda: mission_of(api)["state"] == "flying")
    api.post(f"/v1/missions/{mission['id']}/cancel")
    return session


@pytest.fixture
def filled(api):
    """Make the page of an experiment without a browser: the page, its feed and its steering."""
    with ExitStack() as opened:

        def fill(name):
            feed, steering = FlightFeed(), Steering(api)
            page = Page(load_experiment(name), feed, steering)
            opened.callback(page.close)
            return page, feed, steering

        yield fill


def seen(api):
    return api.get("/v1/state")["seen"]


def mission_of(api):
    return api.get("/v1/state")["mission"]


def button(page, name):
    return page.get_by_role("button", name=name, exact=True)


@pytest.fixture
def page(browse, flight):
    opened = browse(f"{flight[1]}&fixedDpr=0.25")
    opened.set_default_timeout(LIMIT * 1e3)
    button(opened, "STOP").wait_for()
    button(opened, "Send").wait_for()  # STOP is there before the scene is connected
    return opened


def z_arrow(page):
    """Return the middle of the gizmo's blue arrow on the page [px]."""
    for _ in range(20):  # the scene appears slowly
        shot = page.screenshot(timeout=LIMIT * 1e3, scale="css")
        picture = Image.open(io.BytesIO(shot)).convert("RGB")
        red, green, blue = np.moveaxis(np.asarray(picture, dtype=int)[:, 350:930], -1, 0)
        rows, columns = np.nonzero((blue > 200) & (red < 100) & (blue - green > 60))
        if len(rows) > 5:  # drawn small: a quarter of the pixels
            return float(np.median(columns)) + 350, float(np.median(rows))
        page.wait_for_timeout(500)
    raise AssertionError("no gizmo")


@pytest.mark.process
@pytest.mark.alone
def test_drag_and_send_moves_the_setpoint(flight, page, monkeypatch):
    api, _, run = flight
    numbers = page.get_by_role("textbox")

    def target():
        return [float(numbers.nth(axis).input_value()) for axis in range(3)]

    def stands_still():
        before = target()
        page.wait_for_timeout(500)
        return target() == before

    before, (x, y) = target(), z_arrow(page)
    page.mouse.move(x, y)
    page.mouse.down()
    for up in (20, 40):
        page.mouse.move(x, y - up)
        page.wait_for_timeout(300)
    page.mouse.up()
    wait_until(lambda: target() != before)
    page.wait_for_timeout(1000)
    asked = target()
    button(page, "Send").click()
    wait_until(lambda: mission_of(api))
    mission = mission_of(api)
    assert api.get(f"/v1/missions/{mission['id']}")["route_m"] == [asked]
    api.post(f"/v1/missions/{mission['id']}/cancel")
    api.post("/v1/goto", {"position_m": (0.3, 0.2, 0.9)})
    wait_until(lambda: target() == [0.3, 0.2, 0.9])  # after Send it follows the setpoint again
    # The page may show one more setpoint before it hears of a typed digit.
    wait_until(lambda: not mission_of(api) and stands_still())
    numbers.nth(2).fill("99")
    page.keyboard.press("Enter")
    button(page, "Send").click()
    page.get_by_text("not done:").wait_for()
    beside(run.parents[1], monkeypatch)
    other = start(run, "console", run)
    assert "has a console already" in other.communicate(timeout=LIMIT)[0]
    assert other.returncode == 2


@pytest.mark.process
@pytest.mark.alone
def test_keys_drive_sliders_change_the_delay_and_buttons_steer(flight, page):
    api, _, run = flight
    page.keyboard.down("KeyW")
    wait_until(lambda: seen(api)["position_m"][2] > 0.5)
    page.keyboard.up("KeyW")
    mission = mission_of(api)
    assert mission["name"] == "drive"
    page.get_by_role("tab", name="Link").click()
    page.get_by_role("textbox").first.fill("150")  # the uplink's delay
    pressed_ns = time.monotonic_ns()
    page.keyboard.press("Enter")
    wait_until(lambda: seen(api)["rtt_s"] > 0.15)
    uplink = read_states(run / LINK_FOLDER)[0]
    assert uplink.profile["uplink"]["delay_ms"] == 150
    # From the link's record: the browser draws with the processor, and delays all that flies here.
    assert uplink.since_ns - pressed_ns <= 2_000_000_000
    page.get_by_role("textbox").first.fill("9999")
    page.keyboard.press("Enter")
    wait_until(lambda: page.get_by_role("textbox").first.input_value() == "500")
    page.get_by_role("textbox").first.fill("10")  # with 500 ms no drive ends: the guard holds
    page.keyboard.press("Enter")
    page.get_by_role("tab", name="Steer").click()
    button(page, "Start").click()  # it ends the drive first
    wait_until(lambda: (mission_of(api) or mission)["name"] == "hover")
    wait_until(lambda: mission_of(api)["state"] == "flying")
    for name, state in (("Hold", "held"), ("Resume", "flying")):
        button(page, name).click()
        wait_until(lambda state=state: mission_of(api)["state"] == state)
    button(page, "Cancel").click()
    wait_until(lambda: not mission_of(api))


@pytest.mark.process
@pytest.mark.alone
def test_the_second_browser_reads_and_both_stop(browse, flight, page):
    api, address, _ = flight
    api.post("/v1/goto", {"position_m": (0.0, 0.0, 0.8)})
    second = browse(f"{address}&fixedDpr=0.25")
    second.get_by_text("Read only").wait_for(timeout=LIMIT * 1e3)
    button(second, "STOP").wait_for(timeout=LIMIT * 1e3)
    for width in (1280, 800):
        page.set_viewport_size({"width": width, "height": 800})
        for x, y in ((14, 8), (26, 36)):  # where viser collapses the panel, and opens its settings
            page.mouse.click(width - x, y)
            page.wait_for_timeout(300)
            button(page, "STOP").click(trial=True)
    wait_until(lambda: seen(api)["guard"] != "GROUND")
    button(page, "STOP").click()
    wait_until(lambda: seen(api)["guard"] == "ESTOP", 1.0)

    def acknowledged():
        for browser in (page, second):  # one that stalls loses the controls to the other one
            if button(browser, "Acknowledge").is_visible():
                button(browser, "Acknowledge").click()  # refused while the stop is on its way
        page.wait_for_timeout(1000)
        return seen(api)["guard"] != "ESTOP"

    wait_until(acknowledged)
    second.keyboard.press("Shift+X")
    wait_until(lambda: seen(api)["guard"] == "ESTOP")
    page.close()
    button(second, "Hold").wait_for(timeout=LIMIT * 1e3)


def test_the_first_view_shows_the_whole_mission(filled):
    page, _, _ = filled("paper")
    camera = page._server.initial_camera
    spots = [point.position_m for point in page._experiment.mission.waypoints]
    forward = camera.look_at - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1)) / np.hypot(*forward[:2])
    x, y, depth = np.array([right, np.cross(right, forward), forward]) @ (spots - camera.position).T
    slope = np.tan(camera.fov / 2)
    assert np.abs(x / depth).max() < slope * (1280 - 2 * PANEL_WIDTH) / 800
    assert np.abs(y / depth).max() < slope
    assert forward[0] > abs(forward[1]), "along +x"


def test_controls_of_a_browser_that_left_do_not_end_the_console(filled):
    page, _, steering = filled("hover")
    page._controls = Controls(
        page._server, page.acts, steering, page._feed, page._experiment.world.files
    )
    slider = page._controls._sliders["uplink.delay_ms"]
    steering.conditions = {"uplink.delay_ms": 60.0}
    page.update(1.0)
    assert slider.value == 60.0
    slider.remove()
    steering.conditions = {"uplink.delay_ms": 70.0}
    page.update(2.0)


def test_what_is_unknown_is_a_gap_in_its_chart(filled):
    page, feed, _ = filled("hover")
    for number, delay in enumerate((0.03, 0.03, 0.03, nan, nan, nan, 0.06)):
        feed.take(status(0.1 * number, uplink_delay=delay), 1.0 + number)
    page.update(8.0)
    times, up, down, _ = page._charts[0].data
    assert times.tolist() == [-6.0, -3.0, 0.0]
    assert up == [pytest.approx(30.0), None, pytest.approx(60.0)]
    assert down == [-1.0, None, None], "the axes are drawn if there is a number"


@pytest.mark.parametrize(("name", "axes"), [("hover", 3), ("pillars", 2)])
def test_controls_have_heights_only_for_a_robot_that_flies(filled, name, axes):
    page, _, steering = filled(name)
    controls = Controls(page._server, page.acts, steering, page._feed, page._experiment.world.files)
    handles = page._server.gui._gui_input_handle_from_uuid.values()
    labels = {handle.label for handle in handles if hasattr(handle, "label")}
    keys = {label for label, direction in KEYS.values() if axes == 3 or not direction[2]}
    assert keys == labels & {label for label, _ in KEYS.values()}
    assert tuple(controls._gizmo.active_axes) == (True, True, axes == 3)
    assert len(controls._numbers.value) == axes


def test_in_a_pod_the_page_shows_its_own_robot_of_a_fleet(tmp_path):
    config = tmp_path / "experiment.yaml"
    config.write_text("{fleet: {vary: [{world.robot: pelican}, {world.robot: nano}]}}")
    shown = [in_pod(config, robot).experiment().world.robot for robot in (0, 1)]
    assert shown == ["pelican", "nano"]


def test_in_a_pod_a_slider_requests_a_change_and_returns(monkeypatch, capsys, tmp_path):
    profile = tmp_path / "profile.yaml"
    profile.write_text("uplink: {delay_ms: 40}")
    link = in_pod(profile).link
    link.change(["uplink.delay_ms=120"])
    assert capsys.readouterr().out == "link set uplink.delay_ms=120\n"
    assert "requested; only 'cloudrc console --cluster' carries it out" in link.note
    assert link.read()["uplink"] == {"delay_ms": 120.0}
    monkeypatch.setattr("cloudrc.doors.console.in_pod.OWN_S", 0.0)
    assert link.read()["uplink"] == {"delay_ms": 40}
