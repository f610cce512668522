"""The page of a release's console is forwarded, and the console's log is read."""

import pytest

from cloudrc.cluster.client import ClusterError
from cloudrc.cluster.console import follow_page
from tests.cluster.conftest import pod

KUBECTL = """\
case "$*" in
*port-forward*) echo "Forwarding from 127.0.0.1:4321 -> 8090"; exec sleep 60;;
*logs*--container=console*) echo "console: http://127.0.0.1:8090"; echo "link set uplink.loss=0.1";;
esac
"""


def test_a_release_without_a_console_says_how_to_get_one(api, release):
    api.put("pods", pod("cloud-1", "cloud"))
    with pytest.raises(ClusterError, match=r"no console; add it: helm upgrade .*console.enabled"):
        next(follow_page(release, 0, print))


def test_the_page_is_forwarded_and_its_log_is_read(api, release, pretend):
    made = pod("cloud-1", "cloud")
    made["spec"]["containers"].append({"name": "console"})
    api.put("pods", made)
    pretend("kubectl", KUBECTL)
    told = []
    lines = list(follow_page(release, 0, told.append))
    assert told == ["http://127.0.0.1:4321"]
    assert lines[-1] == "link set uplink.loss=0.1"
