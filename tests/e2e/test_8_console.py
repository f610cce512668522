# SPDX-License-Identifier: Apache-2.0

"""The page of a release, in a browser, through a forwarded port."""

import subprocess
import sys

import pytest

from cloudrc.cluster.link import FOLDER
from cloudrc.link.state import STATE_FILE, from_text
from tests.e2e.conftest import (
    CHART,
    NAME,
    NAMESPACE,
    ROOT,
    eventually,
    helm,
    kubectl,
    pod,
    until_ready,
)


@pytest.fixture(scope="module")
def console(installed):
    """`cloudrc console --cluster`, on the release with a console."""
    helm("upgrade", NAME, str(CHART), "--reset-then-reuse-values", "--set", "console.enabled=true")
    until_ready()
    words = ["console", "--cluster", "--no-open", "-n", NAMESPACE, "--release", NAME]
    command = [sys.executable, "-m", "cloudrc", *words]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.terminate()


def delay_in_force():
    """Return the uplink's delay of the link container's own record [ms]."""
    name = pod("world")["metadata"]["name"]
    said = kubectl("exec", name, "--container=link", "--", "cat", f"{FOLDER}/{STATE_FILE}")
    return from_text(said).profile["uplink"]["delay_ms"]


def test_a_slider_of_the_page_changes_the_link(console, browse):
    address = console.stdout.readline().split()[-1]
    page = browse(address)
    page.set_default_timeout(60e3)
    page.get_by_role("button", name="STOP", exact=True).wait_for()
    page.get_by_text("Link", exact=True).click()
    delay = page.locator("input:visible").first
    before = delay.input_value()
    for asked in ("120", before):
        delay.fill(asked)
        delay.press("Enter")
        assert console.stdout.readline().strip() == f"link set uplink.delay_ms={asked}"
        value = float(asked)
        eventually(lambda value=value: delay_in_force() == value, f"a delay of {asked} ms")
