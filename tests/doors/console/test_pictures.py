# SPDX-License-Identifier: Apache-2.0

"""The console shows the newest picture that cloud has, with its age."""

from contextlib import closing
from math import nan

import numpy as np
import pytest

from cloudrc.doors.console import pictures
from cloudrc.doors.console.pictures import PictureFeed
from cloudrc.flight.pod.readers import RecordSender
from tests.doors.console.conftest import status

MS = 1_000_000


@pytest.mark.parametrize(("delay", "age"), [(0.03, 0.13), (nan, 0.1)])
def test_a_picture_has_its_age_in_the_corner_until_a_newer_one_comes(
    tmp_path, monkeypatch, delay, age
):
    ages = []
    monkeypatch.setattr(pictures, "with_age", lambda data, age: ages.append(age) or data)
    with closing(RecordSender(tmp_path)) as sender, closing(PictureFeed(tmp_path)) as feed:
        sender.put([])
        now = status(0.0)._replace(stamp_ns=1100 * MS, uplink_delay=delay)
        assert feed.take(now) is None
        for stamp_ns in (900 * MS, 1000 * MS):
            sender.show_picture(stamp_ns, np.zeros((16, 32, 3), np.uint8))
        assert feed.take(now) is not None
        assert feed.take(now) is None, "pictures come ten times a second"
        assert feed.take(now._replace(stamp_ns=1300 * MS)) is not None
    assert ages == pytest.approx([age, age + 0.2])


def test_the_age_is_written_into_the_picture():
    from cloudrc.wire.pictures import Jpeg

    grey = np.full((64, 96, 3), 128, np.uint8)
    shown = pictures.with_age(Jpeg(95).encode(grey).data, 0.123)
    assert shown.shape == grey.shape
    assert shown[:20, :40].min() < 20 < 230 < shown[:20, :40].max(), "white on black"
    assert np.abs(shown[30:].astype(int) - 128).max() < 8
