# SPDX-License-Identifier: Apache-2.0

"""Changes of the link in flight become sentences for the mission's log."""

from dataclasses import replace

import pytest

from cloudrc.flight.pod.link_news import LOOK_NS, LinkNews
from cloudrc.link.state import LinkState, to_text

WAY = {"delay_ms": 45.0, "jitter_ms": 25.0}
STATE = LinkState(
    "relay", "", "auto", "downlink", {"uplink": WAY, "downlink": WAY}, since="", since_ns=1
)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"profile": {"uplink": {**WAY, "loss": 0.05}, "downlink": {"delay_ms": 70.0}},
          "cause": "the profile's file changed"},
         "the link has changed: uplink.loss 0.05 (was not set), downlink.delay_ms 70 (was 45), "
         "downlink.jitter_ms not set (was 25) (the profile's file changed)"),
        ({"changes": 1, "cause": "link set"}, "the link's schedule has begun again (link set)"),
    ],
)  # fmt: skip
def test_a_change_is_told_once_with_old_and_new_values(tmp_path, changed, said):
    path = tmp_path / "link.json"
    news = LinkNews(path)
    assert news.look(0) == "", "there is no file yet"
    path.write_text(to_text(STATE))
    assert news.look(LOOK_NS) == "", "the first state is no change"
    path.write_text(to_text(replace(STATE, **changed)))
    assert news.look(LOOK_NS + 1) == "", "it is not due"
    assert news.look(2 * LOOK_NS) == said
    assert news.look(3 * LOOK_NS) == ""
