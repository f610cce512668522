# SPDX-License-Identifier: Apache-2.0

"""The supervisor of a local run: feeds, sockets, deadlines, the key."""

import os
import stat

import pytest

from cloudrc.flight.local.supervisor import LocalRun
from cloudrc.flight.machine import AwakeClock


def test_a_clock_does_not_count_the_time_of_a_pause():
    now = 0.0
    clock = AwakeClock(turn_max=1.0, clock=lambda: now)
    for step, shown in ((0.9, 0.9), (7.0, 0.9), (1.0, 1.9)):
        now += step
        assert clock() == pytest.approx(shown)
    assert clock.pause == 7.0


def test_the_key_of_a_run_is_for_its_user_alone_and_goes_with_it(tmp_path, monkeypatch):
    seen = []

    def look(run, limit, files):
        sockets = run._open(tmp_path, {}, files).sockets
        key = sockets / "key"
        seen.append((key, key.stat().st_mode, sockets.stat().st_mode))

    monkeypatch.setattr(LocalRun, "_fly", look)
    before = os.umask(0)  # a user whose new files are open to all
    try:
        LocalRun(tmp_path, lambda records: None).fly(1.0)
    finally:
        os.umask(before)
    ((key, *modes),) = seen
    assert [stat.S_IMODE(mode) for mode in modes] == [0o600, 0o700]
    assert not key.exists()
