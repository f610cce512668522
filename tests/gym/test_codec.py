# SPDX-License-Identifier: Apache-2.0

"""Images of an observation travel encoded: what the policy sees, how large it is, and gaps."""

import copy
import pickle
import sys
from functools import cache
from statistics import fmean

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.gym import Channel, Networked, NetworkedVector
from cloudrc.gym.doubts import LinkWarning
from cloudrc.wire.pictures import Jpeg, psnr
from tests.gym.envs import Counter, Mixed, both_ways


def image(count, rows, columns):
    """Return a picture of waves that move, unlike a photograph at its left edge."""
    y, x = np.mgrid[:rows, :columns]
    waves = [np.sin(0.07 * x + 0.2 * count + n) + np.cos(0.05 * y - n) for n in range(3)]
    return (127 + 60 * np.stack(waves, axis=-1)).astype(np.uint8)


class Eyes(gymnasium.Env):
    """Sees with two cameras, in places of different kinds; a mask is no image."""

    dt = 0.05
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, rows=60, columns=80):
        self._size = rows, columns
        top, side = (
            spaces.Box(0, 255, (*size, 3), np.uint8) for size in ((rows, columns), (32, 32))
        )
        mask = spaces.Box(0, 1, (8, 8, 1), np.uint8)
        self.observation_space = spaces.Dict(
            pixels=spaces.Dict(top=top),
            others=spaces.Tuple((side, mask)),
            count=spaces.Discrete(999),
        )

    def _see(self):
        mask = np.full((8, 8, 1), self.count % 2, np.uint8)
        others = image(self.count, 32, 32), mask
        top = image(self.count, *self._size)[::-1]  # no array of its own, as renderers give it
        return {"pixels": {"top": top}, "others": others, "count": self.count}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self._see(), {}

    def step(self, action):
        self.count += 1
        return self._see(), 0.0, False, self.count == 60, {}


SIDE_BYTES = 8 * 8 + 8  # of what is no image


def play(env, steps=60, seed=1):
    """Play an episode; return what the policy sees and knows in each step, from the reset on."""
    found = [env.reset(seed=seed)]
    for _ in range(steps):
        seen, _, _, _, info = env.step(np.zeros(1, np.float32))
        found.append((seen, info))
    return found


@cache
def raw():
    """Return what a policy without a codec sees in each step; tests must not change it."""
    return [seen for seen, _ in play(Networked(Eyes()))]


def asked(env):
    return [seen["count"] for seen, info in play(env) if info["cloudrc"]["asked"]]


@pytest.mark.parametrize("codec", ["jpeg", "jpeg:20", "h264", "h264:300"])
def test_the_policy_sees_what_the_codec_leaves_of_each_image(codec):
    env, steps = Networked(Eyes(), codec=codec), 22  # with the second key frame
    for (seen, info), bare in zip(play(env, steps), raw()[: steps + 1], strict=True):
        assert env.observation_space.contains(seen)
        assert info["cloudrc"]["observation_age"] == 0.0
        pairs = (
            (seen["pixels"]["top"], bare["pixels"]["top"]),
            (seen["others"][0], bare["others"][0]),
        )
        for left, given in pairs:
            assert 20.0 < psnr(left, given) < 60.0
            left[:] = 0  # the policy may change what it has
        assert seen["count"] == bare["count"]
        assert (seen["others"][1] == bare["others"][1]).all()


@pytest.mark.parametrize("delivery", ["datagrams", "stream"])
def test_an_observation_is_as_large_as_its_images_are_encoded(delivery):
    env = Networked(Eyes(), both_ways(10, 10), codec="jpeg:90", packet_bytes=500, delivery=delivery)
    told = play(env)[-1][1]["cloudrc"]["episode"]["uplink"]
    jpeg, sizes = Jpeg(90), []
    for count in range(1, 61):
        both = image(count, 60, 80)[::-1], image(count, 32, 32)
        sizes.append(SIDE_BYTES + sum(len(jpeg.encode(each).data) for each in both))
    assert len({*sizes}) > 10
    assert told["bytes"] == fmean(sizes)
    assert told["packets_sent"] == sum(-(-size // 500) for size in sizes)


def test_the_larger_a_frame_the_later_it_is_at_a_bottleneck():
    link = {"uplink": {"rate_kbit": 4_000}}
    env = Networked(Eyes(), link, codec="h264:300", packet_bytes=100_000)
    play(env)
    line = env.timeline()
    sizes = (line["arrived"] - line["sent"])[1:-1] * 1e-9 * 4e6 / 8 - 28  # the last is under way
    keys = sizes[[19, 39]]  # one a second, after that of the reset
    assert keys.min() > 1.3 * np.median(sizes)
    told = env.summary()["uplink"]
    assert told["bytes"] == pytest.approx(sizes.mean(), rel=0.02)
    assert told["on_link"] == pytest.approx((told["bytes"] + 28) * 8 / 4e6, abs=1e-5)


@pytest.mark.parametrize(
    ("codec", "missing"),
    [("jpeg", {23}), ("h264", {*range(23, 40)})],  # key frames: 0, 20, 40
)
def test_after_a_loss_h264_waits_for_the_next_key_frame(codec, missing):
    cut = {"blackouts": [{"start_s": 23 * 0.05 - 0.01, "duration_s": 0.02}]}
    env = Networked(Eyes(), {"uplink": cut}, codec=codec)
    assert asked(env) == [n for n in range(61) if n not in missing]
    told = env.summary()["uplink"]
    assert told["loss_measured"] == pytest.approx(1 / 60)
    assert told["shown"] == pytest.approx(1 - len(missing) / 60)
    assert env.summary()["observation_age_max"] == pytest.approx(0.05 * len(missing))


def test_frames_that_overtake_are_decoded_in_their_order():
    late = {"delay_ms": 30, "jitter_ms": 90, "distribution": "uniform"}
    env = Networked(Eyes(), {"uplink": late}, 3, codec="h264")
    counts = []
    for seen, _ in play(env):
        counts.append(seen["count"])
        assert psnr(seen["pixels"]["top"], raw()[seen["count"]]["pixels"]["top"]) > 20.0
    assert counts == sorted(counts)
    assert env.summary()["uplink"]["shown"] > 0.9


@pytest.mark.filterwarnings("ignore:.*arrive whole")
@pytest.mark.parametrize("codec", ["jpeg", "h264"])
def test_a_seed_repeats_every_byte_whatever_was_played_before(codec):
    def played(env, seed):
        every = play(env, 30, seed)
        return b"".join(seen["pixels"]["top"].tobytes() for seen, _ in every), env.summary()

    link = both_ways(40, 40, jitter_ms=30, loss=0.02)
    first, other = (Networked(Eyes(), link, 1, codec=codec) for _ in range(2))
    expected = played(first, 5)
    played(other, 4)
    assert str(played(other, 5)) == str(expected)
    assert played(other, 6)[0] != expected[0]


def test_what_is_doubtful_is_told_of_the_encoded_size_once():
    slow = {"uplink": {"loss": 0.05, "rate_kbit": 2_000}}
    env = Networked(Eyes(), slow, codec="jpeg")
    with pytest.warns(LinkWarning, match="arrive whole") as found:
        env.reset(seed=1)
    assert len(found) == 1  # and not that raw images need more than the rate
    env.reset(seed=2)  # a second warning would be an error
    first = SIDE_BYTES + sum(
        len(Jpeg(70).encode(each).data) for each in (image(0, 60, 80)[::-1], image(0, 32, 32))
    )
    assert first <= env.observation_bytes < 1.07 * first


def test_a_copy_goes_on_as_its_original():
    env = Networked(Eyes(), both_ways(60, 60), codec="jpeg")
    play(env, 10)
    for made in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):  # noqa: S301
        assert str(made.step(np.zeros(1, np.float32))) == str(copy.deepcopy(env).step(np.zeros(1)))
    with pytest.raises(TypeError, match=r"h264 cannot be copied; choose jpeg$"):
        copy.deepcopy(Networked(Eyes(), codec="h264"))


def test_each_robot_of_a_vector_has_a_codec_of_its_own():
    envs = NetworkedVector(SyncVectorEnv([Eyes, Eyes]), "ideal", codec="h264")
    envs.reset(seed=1)
    seen = envs.step(np.zeros((2, 1), np.float32))[0]["pixels"]["top"]
    assert (seen[0] == seen[1]).all()
    assert 20.0 < psnr(seen[0], image(1, 60, 80)[::-1]) < 60.0


@pytest.mark.parametrize(
    ("codec", "env", "text"),
    [
        ("jpg", Eyes(), "codec: no codec named 'jpg'; .* did you mean jpeg"),
        ("jpeg:0", Eyes(), r"codec jpeg:0: .*'0'.* whole number >= 1 and <= 95.*such as jpeg:70"),
        ("jpeg:", Eyes(), "whole number"),
        ("h264:5", Eyes(), r">= 10 and <= 100000 \[kbit/s\]"),
        ("jpeg", Counter(), r"\(height, width, 3\) in Box\(1,\) float64; leave it out$"),
        (
            *("jpeg", Mixed()),
            r"in Dict\(image: Box\(4, 4\) uint8, state: Tuple\(Discrete, Box\(3,\) float64\)\); ",
        ),
        ("h264", Eyes(61), r"\(61, 80, 3\), and H.264 needs even"),
    ],
)
def test_a_codec_that_does_not_fit_is_refused_in_one_line(codec, env, text):
    with pytest.raises(BadInputError, match=text) as error:
        Networked(env, codec=codec)
    assert "\n" not in str(error.value)


def test_a_codec_whose_library_is_missing_and_a_channel_are_refused(monkeypatch):
    with pytest.raises(BadInputError, match="codec: on a channel"):
        Channel([Eyes()], codec="jpeg")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingPrerequisiteError, match=r"pip install 'cloudrc\[camera\]'$"):
        Networked(Eyes(), codec="h264")
