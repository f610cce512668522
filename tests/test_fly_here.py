# SPDX-License-Identifier: Apache-2.0

"""The page "fly it here": its flights, its size, and how it works in a browser."""

import functools
import http.server
import threading

import numpy as np
import pytest

import cloudrc
from tests.support import contrast
from tools.fly_here.flights import EXPERIMENT, RATE_HZ, RECIPES, SEED, Recipe, document, fly, hull
from tools.fly_here.page import BYTES_MAX, write

LOSSY = Recipe("lossy", "last_sample", 300)
READY = "body[data-ready]"
SIZES = {"desktop": (1280, 800), "phone": (390, 844)}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page with all its flights, as `make site` makes it."""
    target = tmp_path_factory.mktemp("site") / "index.html"
    write(target, document(RECIPES))
    return target


@pytest.fixture
def served(page):
    """Address of the page on a server of this machine."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *words):
            pass

    handler = functools.partial(Quiet, directory=page.parent)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/index.html"
        server.shutdown()


def opened(browse, url, size="desktop", scheme="light"):
    """Open the page in a size and a colour scheme, at its end and without a network."""
    shown = browse(url)
    shown.emulate_media(color_scheme=scheme, reduced_motion="reduce")
    width, height = SIZES[size]
    shown.set_viewport_size({"width": width, "height": height})
    shown.context.set_offline(True)
    shown.reload()
    shown.wait_for_selector(READY)
    return shown


def test_some_60_recipes_cover_all_that_the_page_offers():
    kinds = [set(column) for column in zip(*RECIPES, strict=True)]
    assert [len(kind) for kind in kinds] == [3, 3, 7]
    assert len(set(RECIPES)) == 63
    assert (min(kinds[2]), max(kinds[2])) == (0, 600)


@pytest.mark.filterwarnings("ignore:commands follow their odometry")  # HOLD is wanted here
def test_a_track_is_the_flight_to_half_a_centimetre_with_its_verdict_and_ages(monkeypatch):
    flown, once = [], cloudrc.fly

    def keep(*asked, **more):
        assert (asked, more) == ((EXPERIMENT, LOSSY.settings), {"seed": SEED})
        flown.append(once(*asked, **more))
        return flown[-1]

    monkeypatch.setattr(cloudrc, "fly", keep)
    shown = fly(LOSSY)
    (result,) = flown
    positions = np.cumsum(shown["robot"], axis=1).T / 100
    at_ns = result.flight.mission_ns + np.arange(len(positions)) * 10**9 // RATE_HZ
    assert np.abs(positions - result.flight.true_position(at_ns)).max() <= 0.0051
    assert (shown["verdict"], shown["text"]) == ("failure", "it touched pipe_1")
    assert result.failures[0].text.startswith("the robot touched pipe_1")
    applied = result.flight.during("/command_applied")
    row = applied["stamp_ns"].searchsorted(at_ns, "right") - 1
    behind_ms, shown_ms = (
        (at_ns - applied["basis_stamp_ns"][row]) / 1e6,
        10 * np.array(shown["age"]),
    )
    is_used = shown_ms >= 0
    assert 0 < is_used.sum() < len(is_used), "with HOLD"
    assert np.abs(behind_ms - shown_ms)[is_used].max() <= 5.1
    assert len(shown["age"]) == len(positions)


def test_the_outline_of_a_square_has_its_four_corners():
    inside = [(0.5, 0.5), (1.0, 0.5)]
    corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    assert hull(np.array([*inside, *corners])) == [list(each) for each in corners]


def test_a_page_that_is_too_heavy_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("tools.fly_here.page.BYTES_MAX", 1000)
    with pytest.raises(SystemExit, match="above 1000"):
        write(tmp_path / "index.html", {})


@pytest.mark.process
@pytest.mark.alone
def test_the_first_picture_comes_within_a_second(browse, page, served):
    assert page.stat().st_size <= BYTES_MAX
    first = browse(served)  # a browser that has just started draws seconds later
    first.wait_for_function("performance.getEntriesByName('first-contentful-paint').length")
    first.close()
    shown = browse(served)
    shown.wait_for_selector(READY)
    # The browser notes it once a frame is on the screen, which is after the drawing.
    shown.wait_for_function("performance.getEntriesByName('first-contentful-paint').length")
    marks = shown.evaluate("performance.getEntries().map(one => [one.name, one.startTime])")
    assert max(dict(marks)[name] for name in ("first-contentful-paint", "drawn")) <= 1000


@pytest.mark.process
@pytest.mark.alone
@pytest.mark.parametrize("size", SIZES)
def test_it_flies_from_a_file_without_a_network(browse, page, size):
    shown = opened(browse, page.as_uri(), size)
    assert shown.evaluate("document.documentElement.scrollWidth <= innerWidth")
    told = shown.locator("#told")
    choices = shown.get_by_role("form", name="flight A")
    choices.get_by_role("slider").fill("0")
    choices.get_by_label("last_sample").check()
    assert "A with last_sample arrives after" in told.inner_text()
    choices.get_by_role("slider").press("End")
    assert "round trip 600\u00a0ms.\nA with last_sample fails" in told.inner_text()
    assert "B with model_based arrives after" in told.inner_text()
    before = pixels(shown)
    shown.keyboard.press("Space")
    shown.get_by_role("button", name="Pause").click()
    shown.locator("#time").fill("1")
    assert all(now != then for now, then in zip(pixels(shown), before, strict=True))
    choices.get_by_label("lossy").check()
    address = shown.url
    shown.goto("about:blank")
    shown.goto(address)
    shown.wait_for_selector(READY)
    assert shown.locator("form.B [value=lossy]").is_checked()


def pixels(shown):
    """Return the pixels of both flights."""
    return shown.evaluate(
        "[...document.querySelectorAll('.view canvas')].map(one => one.toDataURL())"
    )


INKS = f"""() => {{ {contrast.FUNCTIONS}
  const poor = [], style = getComputedStyle(document.documentElement);
  const named = (name) => light([1, 3, 5].map((at) =>
    parseInt(style.getPropertyValue(`--${{name}}`).trim().slice(at, at + 2), 16)));
  for (const name of ['young', 'old', 'hold', 'ghost', 'fails', 'ink'])
    for (const behind of ['paper', 'wall'])
      if (ratio(named(name), named(behind)) < 3) poor.push(`${{name}} on ${{behind}}`);
  return poor; }}"""
"""Returns the colours of the drawings below the 3 of WCAG 2.2, 1.4.11."""


@pytest.mark.process
@pytest.mark.alone
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_texts_and_drawings_have_the_contrast_of_wcag_aa(browse, page, scheme):
    shown = opened(browse, page.as_uri(), scheme=scheme)
    shown.locator("summary").click()
    assert shown.evaluate(contrast.TEXTS) == []
    assert shown.evaluate(INKS) == []
