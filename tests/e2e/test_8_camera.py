# SPDX-License-Identifier: Apache-2.0

"""Pods render what the robot's camera sees, and the console of a release shows it."""

import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from tests.e2e.conftest import (
    CHART,
    NAME,
    NAMESPACE,
    ROOT,
    eventually,
    fly,
    helm,
    identity,
    job_end,
    metrics,
    report,
    until_ready,
    value,
)

MOVING_WITHIN = 10.0
"""Time from ready pods until the console's page shows moving pictures [s]."""
PERIOD = 1 / 15
"""Between two pictures of x2 [s]."""


@pytest.fixture(scope="module")
def eyes(installed, values, tmp_path_factory):
    """The release with the experiment `follow` and a console."""
    file = tmp_path_factory.mktemp("eyes") / "values.yaml"
    experiment = yaml.safe_load(dump(load_experiment("follow")))
    file.write_text(yaml.safe_dump({"console": {"enabled": True}, "experiment": experiment}))
    helm("upgrade", NAME, str(CHART), f"--values={values}", f"--values={file}")
    yield experiment
    helm("upgrade", NAME, str(CHART), f"--values={values}")
    until_ready()


@pytest.fixture
def address(eyes):
    """Wait for the pods; yield the page's address while `cloudrc console` serves it."""
    until_ready()
    words = ["console", "--cluster", "--no-open", "-n", NAMESPACE, "--release", NAME]
    command = [sys.executable, "-m", "cloudrc", *words]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        yield process.stdout.readline().split()[-1]
        process.terminate()


LOWER_HALF = """async picture => {
    try { await picture.decode(); } catch { return []; }  // the next one has come meanwhile
    const drawn = new OffscreenCanvas(32, 12).getContext("2d"), half = picture.naturalHeight / 2;
    drawn.drawImage(picture, 0, half, picture.naturalWidth, half, 0, 0, 32, 12);
    return [...drawn.getImageData(0, 0, 32, 12).data];
}"""
"""Returns the points of a picture on the page, without the age in its corner; or nothing."""
CHANGE = 40
"""Change of a point's colour that no codec makes."""


def has_moved(first, now):
    return bool(now) and np.abs(np.subtract(first, now)).max() > CHANGE


@pytest.mark.real_time
def test_a_flight_shows_moving_pictures_in_the_console(eyes, chromium, browse, address, note):
    began = time.monotonic()  # the pods are ready, and the page can be opened
    fly("eyes", (), limit=90.0, follow=eyes["mission"]["follow"])
    page = browse(address)
    page.set_default_timeout(60e3)
    picture = page.locator("img[src^='blob:']").first
    picture.wait_for()
    first = eventually(lambda: picture.evaluate(LOWER_HALF), "a picture", every=0.1)
    shown = time.monotonic() - began
    eventually(lambda: has_moved(first, picture.evaluate(LOWER_HALF)), "it moves", every=0.1)
    moving = time.monotonic() - began
    before = identity()
    end, _ = job_end("eyes")
    assert (end.exit_code, identity()) == (0, before), end
    late, took = (
        value(metrics("world"), f"cloudrc_camera_{each}")
        for each in ("late_total", "seconds_count")
    )
    note(f"console: a picture after {shown:.1f} s, moving after {moving:.1f} s")
    note(f"{took:.0f} pictures taken, {late:.0f} late")
    assert took > 100
    assert moving < MOVING_WITHIN


@pytest.mark.real_time
def test_its_report_tells_of_the_pictures(eyes, tmp_path, note):
    numbers = report(tmp_path / "eyes", NAME)["numbers"]
    due = eyes["mission"]["follow"]["duration_s"] / PERIOD
    note(f"frames late: {numbers['frames_late']['value'] / due:.0%}")
    assert numbers["frames_shown"]["value"] > 0.95
    assert numbers["out_of_view"]["value"] < 0.05
