# SPDX-License-Identifier: Apache-2.0

"""The replay: its content, its size, and its movement together with the figures in a browser."""

import json
import re
import sys
from base64 import b64decode

import msgspec
import numpy as np
import pytest
import zstandard
from PIL import Image

from cloudrc.results.report import replay
from cloudrc.results.report.document import Run
from cloudrc.results.report.figures import FIGURES
from cloudrc.results.report.write import assess, write_report
from tests.results.metrics.conftest import OPEN_AIR, Log, paper


@pytest.fixture(scope="module")
def flight():
    return assess(*reversed(paper()), Run("virtual", "virtual")).flight


@pytest.fixture(scope="module")
def section(flight):
    return replay.write_section(flight, paper()[0])


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Address of the report of the shipped experiment."""
    folder = tmp_path_factory.mktemp("run")
    write_report(folder, *reversed(paper()), Run("virtual", "virtual"))
    return (folder / "report.html").as_uri()


def messages(section):
    """Decode viser's recording in a replay: duration [s], and (time [s], message) pairs."""
    player = json.loads(re.search(r'id="player">(.*?)</script>', section, re.DOTALL)[1])
    data = b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', player)[1])
    raw = zstandard.ZstdDecompressor().decompress(data[8:])
    found = msgspec.msgpack.decode(raw[8 : 8 + int.from_bytes(raw[:8], "little")])
    return found["durationSeconds"], found["messages"]


def test_the_replay_shows_the_flight_and_the_prediction(flight, section):
    duration, said = messages(section)
    assert duration == pytest.approx(flight.seconds(flight.end_ns))
    places = {"/robot": [], "/ghost": []}
    for now, message in said:
        if message["type"] == "SetPositionMessage" and message["name"] in places:
            places[message["name"]].append((now, *message["position"]))
    times, *robot = np.array(places["/robot"][1:]).T
    true = flight.true_position(flight.mission_ns + times * 1e9)
    assert np.nanmax(np.abs(np.transpose(robot) - true)) < 0.03  # a row is at most 10 ms old
    assert len(times) > 0.95 * duration * replay.RATE
    ghost = np.array(places["/ghost"])
    behind = ghost[:, 1:] - flight.true_position(flight.mission_ns + ghost[:, 0] * 1e9)
    assert 0.005 < np.sqrt(np.square(behind).sum(axis=1).mean()) < 0.04
    green = [
        m for _, m in said if m["type"] == "SceneNodeUpdateMessage" and "color" in m["updates"]
    ]
    assert len(green) == 7


def test_a_minute_of_flight_takes_less_than_2_mb(flight, section):
    minutes = flight.seconds(flight.end_ns) / 60
    assert len(section) / minutes <= 2e6


@pytest.mark.parametrize(("lack", "words"), [("viser", "pip install"), ("flight", "never flew")])
def test_without_replay_a_line_says_why(lack, words, tmp_path, monkeypatch):
    monkeypatch.setattr("cloudrc.results.report.figures.FIGURES", {"error": FIGURES["error"]})
    experiment, recording = paper()
    if lack == "viser":
        monkeypatch.setitem(sys.modules, "viser", None)
        for name in ("cloudrc.results.report.replay", "cloudrc.results.report.scene"):
            monkeypatch.delitem(sys.modules, name)
    else:
        recording = Log().flight(OPEN_AIR).recording
    write_report(tmp_path, recording, experiment, Run("virtual", "virtual"))
    page = (tmp_path / "report.html").read_text()
    (line,) = re.findall(r'<p class="note" id="replay">(.*?)</p>', page)
    assert line.startswith("No replay in 3-D: ")
    assert words in line
    assert page.count("<img ") == (2 if lack == "viser" else 1)  # a still picture of what flew


@pytest.mark.process
def test_replay_and_figures_move_together(browse, page, tmp_path):
    shown = browse(page)
    shown.set_default_timeout(90_000)
    assert shown.locator("#still").is_hidden()
    player = shown.frame_locator("#replay iframe")
    slider, field = player.locator("[role=slider]"), player.locator("input").first
    slider.wait_for(state="attached")
    panel = shown.locator("#odom .plot > span").first
    panel.scroll_into_view_if_needed()
    box, duration = panel.bounding_box(), float(slider.get_attribute("aria-valuemax"))
    shown.mouse.click(box["x"] + box["width"] / 2, box["y"] + 5)
    now = "document.documentElement.style.getPropertyValue('--now')"
    shown.wait_for_function(f"Math.abs(parseFloat({now}) - 50) < 0.3")
    assert float(slider.get_attribute("aria-valuenow")) == pytest.approx(duration / 2, abs=0.1)
    shown.locator("#replay .stage.small").wait_for()
    field.fill("3")
    shown.wait_for_function(f"Math.abs(parseFloat({now}) - {300 / duration}) < 0.3")
    scene = player.locator("canvas").first
    scene.wait_for()
    shown.wait_for_timeout(3000)  # viser fades the scene in
    scene.screenshot(path=tmp_path / "scene.png")
    colours = Image.open(tmp_path / "scene.png").convert("RGB").getcolors(1 << 24)
    assert len(colours) > 300


@pytest.mark.process
def test_without_webgl_there_is_a_still_picture_and_the_figures_remain(browse, page):
    shown = browse(page)
    shown.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    shown.reload()
    assert "WebGL is off" in shown.locator("#no3d").inner_text()
    assert shown.locator("#replay .room").is_hidden()
    assert shown.locator("iframe").count() == 0
    assert shown.locator("#still img").is_visible()
    assert shown.locator("figure img").count() == len(FIGURES) + 1
    assert shown.evaluate("[...document.images].every(one => one.naturalWidth > 0)")
