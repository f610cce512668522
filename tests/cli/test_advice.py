"""Warnings before a flight: settings that do not fit together, with a key and value that would."""

import pytest

from cloudrc.cli.advice import advise
from cloudrc.config import shipped
from cloudrc.config.load import load_experiment


def both(delay, jitter):
    ways = ("uplink", "downlink")
    return [
        f"link.{way}.{key}={value}"
        for way in ways
        for key, value in (("delay_ms", delay), ("jitter_ms", jitter))
    ]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (both(125, 50), ("250 ms, up to 350 ms", "often holds; ", "command_age_max_ms=380")),
        (both(750, 0), ("never flies; ", "command_age_max_ms=1520")),
        (both(750, 0), ("more than cloud predicts; ", "cloud.horizon_max_s=1.5")),
        (both(300, 250), ("cloud freezes at times; ", "cloud.freeze_after_s=0.6")),
        (["cloud.controller={name: pid, gain_i: [0.3, 0, 0]}"], ("cloud.controller.speed_max=6",)),
        (
            [
                "cloud.predictor=commanded_velocity",
                "cloud.controller.gain_p=[6, 6, 6]",
                *both(100, 0),
            ],
            ("product 1.20, above 1", "gains below 5"),
        ),
    ],
)
def test_what_does_not_fit_is_named_with_a_value_that_fits(settings, words):
    texts = list(advise(load_experiment("paper", settings)))
    assert any(all(word in text for word in words) for text in texts), texts


def test_each_shipped_profile_is_flown_without_a_warning():
    for profile in shipped.names("profile"):
        assert list(advise(load_experiment("paper", [f"link.profile={profile}"]))) == []


def test_the_values_that_fit_are_accepted_without_a_warning():
    fits = ["guard.command_age_max_ms=1520", "cloud.horizon_max_s=1.5"]
    assert list(advise(load_experiment("paper", [*both(750, 0), *fits]))) == []
