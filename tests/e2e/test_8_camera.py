# SPDX-License-Identifier: Apache-2.0

"""Pods render what the robot's camera sees, and the console of a release shows it."""

import subprocess
import sys
import time

import pytest
import yaml

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from tests.e2e.conftest import (
    CHART,
    NAME,
    NAMESPACE,
    ROOT,
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


WATCH = """
const seen = window.seenPictures = {shown: null, moving: null};
let first = null;
async function look(picture) {
    try { await picture.decode(); } catch { return; }  // the next one has come meanwhile
    seen.shown ??= Date.now();
    const drawn = new OffscreenCanvas(32, 12).getContext("2d"), half = picture.naturalHeight / 2;
    drawn.drawImage(picture, 0, half, picture.naturalWidth, half, 0, 0, 32, 12);
    const now = [...drawn.getImageData(0, 0, 32, 12).data];
    first ??= now;
    if (now.some((value, n) => Math.abs(value - first[n]) > 40)) seen.moving ??= Date.now();
}
const isPicture = node => node instanceof HTMLImageElement && node.src.startsWith("blob:");
new MutationObserver(changes => changes.flatMap(
    each => [each.target, ...each.addedNodes].flatMap(
        node => [node, ...(node.querySelectorAll?.("img") ?? [])]
    )
).filter(isPicture).forEach(look)).observe(
    document, {subtree: true, childList: true, attributes: true, attributeFilter: ["src"]}
);
"""
"""Notes when the page shows a picture, and when one that differs by more than a codec makes [ms].
Only the lower half counts, which has no age in it. The page notes it itself: a processor draws the
scene meanwhile, so that an answer to a question from outside takes seconds."""


@pytest.mark.real_time
def test_a_flight_shows_moving_pictures_in_the_console(eyes, browse, address, note):
    began = time.time()  # the pods are ready, and the page can be opened
    fly("eyes", (), limit=90.0, follow=eyes["mission"]["follow"])
    page = browse(address, script=WATCH)
    page.wait_for_function("seenPictures.moving", timeout=60e3)
    seen = page.evaluate("seenPictures")
    shown, moving = (seen[each] / 1e3 - began for each in ("shown", "moving"))
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
