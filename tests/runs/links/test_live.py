"""A link whose profile changes while it runs says which direction has changed."""

import contextlib

import pytest

from cloudrc.config.load import edit_profile
from cloudrc.outside.document import Document
from cloudrc.runs.links.change import set_here
from cloudrc.runs.links.live import LiveLink
from cloudrc.runs.links.programs import link_folder


@pytest.mark.parametrize(
    ("profile", "settings", "changed"),
    [
        (None, ["uplink.delay_ms=300"], ["uplink"]),
        (None, ["downlink.loss=0.5"], ["downlink"]),
        (None, ["uplink.delay_ms=300", "downlink.delay_ms=1"], ["uplink", "downlink"]),
        (None, ["uplink.delay_ms=30"], []),  # as before
        ("lte", [], ["uplink", "downlink"]),  # the time lines begin again
    ],
)
def test_a_change_is_told_for_the_directions_that_it_changes(profile, settings, changed):
    told = []
    with contextlib.ExitStack() as stack:
        folder, url = link_folder(None, stack)
        live = LiveLink(edit_profile(Document({}), "lte", []), folder, url, "a test")
        stack.callback(live.close)
        live.serve(
            lambda change: change(),
            lambda way, loaded, now_ns: None,
            lambda state, news: told.append(news),
        )
        edit, states = set_here(folder / "link", url, profile, settings, "1")
    assert [state.changes for state in states] == [1, 1]
    assert [news for news in told if news] == [
        f"the {way} has changed: {edit.cause}" for way in changed
    ]
