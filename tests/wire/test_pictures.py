# SPDX-License-Identifier: Apache-2.0

"""Pictures survive their codec as well as it says, and damage is no picture."""

import io
import sys

import numpy as np
import PIL.Image
import pytest

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.config.camera import CodecConfig
from cloudrc.wire.pictures import as_png, make_decoder, make_encoder, psnr

KIND = (160, 120, 10)


def picture(k):
    """Return a picture of waves that move."""
    y, x = np.mgrid[:120, :160]
    waves = [np.sin(0.07 * x + 0.2 * k + n) + np.cos(0.05 * y - n) for n in range(3)]
    return (127 + 60 * np.stack(waves, axis=-1)).astype(np.uint8)


def coded(codec, count=12):
    encoder, decoder = make_encoder(codec, *KIND), make_decoder(codec.codec)
    for k in range(count):
        encoded = encoder.encode(picture(k))
        yield encoded, decoder.decode(encoded.data), picture(k)


def test_a_jpeg_stands_alone_and_a_higher_quality_takes_more_bytes():
    rows = {quality: [*coded(CodecConfig(quality=quality), 2)] for quality in (30, 90)}
    for each in rows.values():
        assert all(encoded.key for encoded, _, _ in each)
    low, high = (psnr(rows[quality][1][1], picture(1)) for quality in (30, 90))
    assert 25 < low < high
    assert len(rows[30][1][0].data) < len(rows[90][1][0].data)


def test_h264_has_its_key_frames_and_its_rate():
    codec = CodecConfig(codec="h264", kbit=200, key_every_s=0.5)
    rows = [*coded(codec, 60)]
    assert [k for k, (encoded, _, _) in enumerate(rows) if encoded.key] == [*range(0, 60, 5)]
    assert all(psnr(decoded, image) > 25 for _, decoded, image in rows), "none is held back"
    assert sum(len(encoded.data) for encoded, _, _ in rows) * 8 / 6 < 1.2 * 200e3


@pytest.mark.parametrize("name", ["jpeg", "h264"])
def test_the_same_pictures_make_the_same_bytes(name):
    first, again = ([*coded(CodecConfig(codec=name), 5)] for _ in range(2))
    assert [each.data for each, _, _ in first] == [each.data for each, _, _ in again]


@pytest.mark.parametrize("name", ["jpeg", "h264"])
def test_what_is_no_picture_is_none(name):
    assert make_decoder(name).decode(b"no picture") is None


@pytest.mark.parametrize(("name", "module"), [("jpeg", "PIL.Image"), ("h264", "av")])
def test_a_codec_that_is_not_installed_is_told_in_one_line(name, module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingPrerequisiteError, match=r"pip install 'cloudrc\[camera\]'$"):
        make_encoder(CodecConfig(codec=name), *KIND)


def test_psnr_and_png_by_hand():
    image = picture(0)
    assert psnr(image, image) == pytest.approx(100.0)
    assert psnr(np.zeros((2, 2, 3)), np.full((2, 2, 3), 51)) == pytest.approx(13.979, abs=1e-3)
    assert (np.asarray(PIL.Image.open(io.BytesIO(as_png(image)))) == image).all()
