"""Faults of the surroundings: clocks, configuration, keys, and a second cloud."""

from __future__ import annotations

import io
import re
import tempfile
from contextlib import redirect_stderr
from math import nan
from pathlib import Path

from cloudrc.drivers.keyfile import PERIOD_NS, KeyFile
from cloudrc.drivers.recording import WallClock, told
from cloudrc.errors import BadInputError
from cloudrc.faults import asks
from cloudrc.faults import asks as meters
from cloudrc.faults.flight import SECRET, Crowd, Flight
from cloudrc.faults.held import AGE_MAX
from cloudrc.faults.models import Clock
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.faults.scenarios.link import HOUR_NS, instant
from cloudrc.faults.walls import jumping_wall_clock, steppable_wall_clock
from cloudrc.messages import GuardState
from cloudrc.records import Fault
from cloudrc.tunnel.handshake import BUSY_TEXT
from cloudrc.tunnel.keys import Key, KeySet, write

BAD_KEYS = (
    ("guard.command_age_max_ms=0", "guard.command_age_max_ms"),
    ("guard.command_age_max_ms=.inf", "guard.command_age_max_ms"),
    ("guard.speed_max_mps=-1", "guard.speed_max_mps"),
    ("guard.speed_max_mps=.nan", "guard.speed_max_mps"),
    ("guard.command_age_max=0.25", "command_age_max_ms"),
    ("link.uplink.delay=45", "delay_ms"),
    ("link.profile=paper-p9", "paper-p"),
    ("cloud.predictor=kalmann", "constant_velocity"),
    ("world.robot=pelikan", "pelican"),
)
"""What is set, and a word that the refusal has to name."""


def _wall_clocks(seed: int) -> Outcome:
    outcome = Outcome()
    clean = Flight(seed=seed).fly_mission()
    with jumping_wall_clock():
        flight = Flight(seed=seed).fly_mission()
    asks.safe(outcome, flight)
    outcome.true(
        "wall clocks step: the same records, bit by bit", clean.sha256() == flight.sha256()
    )
    for role in ("world", "cloud"):
        shown = [meters.shown(each, role) for each in (clean, flight)]
        outcome.true(f"every reading of {role} is the same", shown[0] == shown[1])
    _stepped(outcome)
    for hours in (-1, 1):
        apart = Flight(seed=seed, cloud_clock=Clock((48 + hours) * HOUR_NS)).fly_mission()
        text = f"cloud's clock {48 + hours} h ahead: the same path, bit by bit"
        outcome.true(text, asks.same_path(clean, apart))
    for ppm in (-500, 500):
        drifting = Flight(seed=seed, cloud_clock=Clock(HOUR_NS, ppm)).fly_mission()
        asks.safe(outcome, drifting)
        asks.done(outcome, drifting)
        outcome.same(f"drift of {ppm} ppm: HOLDs", len(asks.held(drifting)), 0)
    return outcome


def _stepped(outcome: Outcome) -> None:
    """Set the wall clock of an end between two looks of its recording's thread, of four."""
    with steppable_wall_clock() as wall:
        clock = WallClock()
        steps = [clock.step()]
        wall.step(-3600.0)
        steps += [clock.step() for _ in range(3)]
    faults = [told(step, 0) for step in steps if step]
    outcome.same("faults told: wall_clock", len(faults), 1)
    said = [re.match(r"wall clock stepped by (\S+) s", fault.text) for fault in faults]
    by = min((float(match[1]) for match in said if match), default=nan)
    outcome.most("what it says differs from what it was set by", abs(by + 3600.0), 1.0, "s")
    for role in ("world", "cloud"):
        shown = meters.reading(role, faults, "clock_steps_total")
        outcome.same(f"metric clock_steps_total of {role}", shown, 1)


def _two_clouds(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed, 4.0, 12.0)
    flight = Flight(seed=seed, second=at)
    crowd = flight.cloud.inner
    assert isinstance(crowd, Crowd)
    opened: list[int] = []
    flight.world.at(at + 5.0, lambda _: opened.extend(asks.epochs(flight)))

    def leave(now_ns: int) -> None:
        crowd.members = crowd.members[1:]

    flight.cloud.at(at + 6.0, leave)
    flight.fly(at + 14.0)
    asks.safe(outcome, flight)
    outcome.same("epochs while both are there", max(opened, default=-1), 2)
    held = asks.changes_into(flight, GuardState.HOLD, at + 6.0)
    outcome.same("HOLDs while both are there", len(held), 0)
    meters.moves(outcome, flight, "world", "datagrams_total", "downlink", "busy", since=at)
    meters.moves(outcome, flight, "world", "sessions_refused_total", since=at)
    outcome.least("the second is refused", flight.world.inner._counts["busy"], 1)  # type: ignore[union-attr]
    told = [r for r in crowd.others if isinstance(r, Fault) and r.code == "busy"]
    outcome.true("the second says why it waits, once", [r.text for r in told] == [BUSY_TEXT])
    said = min((r.stamp_ns * 1e-9 for r in told), default=nan)
    outcome.most("it says so after", said - at, 1.0, "s")
    by_first = [r for r in meters.seen_by(flight, "cloud", at + 6.0) if isinstance(r, Fault)]
    outcome.same("faults that the first tells of", len(by_first), 0)
    outcome.most("HOLD once the first is gone", asks.basis_age_at_hold(flight), AGE_MAX, "s")
    later = [epoch for epoch in asks.epochs(flight) if epoch > 2]
    outcome.true("then the second gets a higher epoch", bool(later))
    outcome.true("commands applied in order, none twice", asks.applied_in_order(flight))
    return outcome


def _configuration(seed: int) -> Outcome:
    outcome, codes = Outcome(), list[int]()
    for setting, word in BAD_KEYS:
        code, said = _started("run", "paper", "--set", setting)
        codes.append(code)
        right = word in said and said.count("\n") == 1
        outcome.true(f"{setting} is refused in one line, naming {word}", right)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "bad.yaml"
        key = Path(folder) / "key"
        key.write_text(write(SECRET), encoding="utf-8")
        file.write_text("guard: {command_age_max_ms: 0}\n", encoding="utf-8")
        for end in ("world", "cloud"):
            ports = ("--listen", "127.0.0.1:7400", "--peer", "127.0.0.1:1")
            code, said = _started(end, "--config", str(file), "--key", str(key), *ports)
            codes.append(code)
            right = str(file) in said and "guard.command_age_max_ms" in said
            outcome.true(f"{end} does not start, naming file and key", right)
    outcome.same("exit codes other than 2", sum(code != 2 for code in codes), 0)
    return outcome


def _started(*arguments: str) -> tuple[int, str]:
    """Run a command line; give its exit code and what it says of errors."""
    from cloudrc.cli.main import main  # which knows of this module

    said = io.StringIO()
    with redirect_stderr(said):
        return main(arguments), said.getvalue()


def _secrets(seed: int) -> Outcome:
    outcome, wrong = Outcome(), KeySet(Key(bytes(31) + b"\1"))
    flight = Flight(seed=seed, secrets={"world": SECRET, "cloud": wrong}).fly(6.0)
    asks.safe(outcome, flight)
    outcome.same("wrong key: sessions", len(asks.epochs(flight)), 0)
    outcome.same("wrong key: changes of the guard", len(flight.changes), 0)
    meters.moves(outcome, flight, "world", "datagrams_total", "downlink", "tag", since=0.0)
    for end, code, records in (
        ("world", "key", flight.of_world),
        ("cloud", "no_session", flight.of_cloud),
    ):
        told = [r.text for r in records if isinstance(r, Fault) and r.code == code]
        right = len(told) == 1 and "same key" in told[0]
        outcome.true(f"wrong key: {end} tells once to look at the keys", right)

    new = KeySet(Key(b"the next key of the fault suite!"), SECRET.current)
    outcome.add(_rotated(seed, new, gap=8.0, gone=False))
    outcome.add(_rotated(seed, KeySet(new.current), gap=8.0, gone=True))
    _missing(outcome, seed)
    return outcome


def _missing(outcome: Outcome, seed: int) -> None:
    """No process starts without the Secret; one that has read it keeps what it knows."""
    with tempfile.TemporaryDirectory() as folder:
        path, said = Path(folder) / "key", ""
        try:
            KeyFile(path, 0)
        except BadInputError as error:
            said = str(error)
        told = str(path) in said and "cloudrc key new" in said
        outcome.true("missing key: refused, with the file and what to do", told)
        path.write_text(write(SECRET), encoding="utf-8")
        keys = KeyFile(path, 0)
        before = keys.ring.keys
        path.unlink()
        told = bool(keys.follow(PERIOD_NS)) or keys.ring.keys != before
        outcome.true("gone in flight: the keys stay as they are", not told)
    flight = Flight(seed=seed)
    flight.cloud.kill(0)  # its pod waits for the Secret
    flight.cloud.at(5.0, flight.cloud.start)
    flight.fly(5.0)
    outcome.same("missing key: sessions", len(asks.epochs(flight)), 0)
    outcome.same("missing key: changes of the guard", len(flight.changes), 0)
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)


def _rotated(seed: int, new: KeySet, gap: float, *, gone: bool) -> Outcome:
    """World reads the new Secret, cloud a while later; the old key is in it, or gone."""
    outcome, at = Outcome(), instant(seed, 4.0, 8.0)
    flight = Flight("criteria.time_limit_s=120", seed=seed)
    flight.world.at(at, lambda now_ns: flight.rotate("world", new, now_ns))
    flight.cloud.at(at + gap, lambda now_ns: flight.rotate("cloud", new, now_ns))
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    what = f"rotated {gap:g} s apart, the old key {'gone' if gone else 'kept'}"
    if gone:
        outcome.least(f"{what}: HOLDs", len(asks.held(flight)), 1)
        back = asks.resumed_after(flight, at + gap)
        outcome.most(f"{what}: TRACK again after", back, 2.0, "s")
    else:
        outcome.most(f"{what}: HOLDs", len(asks.held(flight)), 1)
    return outcome


SCENARIOS = (
    Scenario(
        9,
        "clock-steps",
        "wall clocks step to 1970, 2106 and by an hour, two clocks lie hours "
        "apart, one drifts by 500 ppm",
        "the same flight, bit by bit; drift is flown in TRACK",
        "none",
        "fault 'wall_clock' with the size of the step; cloudrc_clock_steps_total",
        _wall_clocks,
    ),
    Scenario(
        25,
        "two-clouds",
        "a second cloud with the same key; later the first one leaves",
        "the first keeps authority while fresh; after HOLD the second gets a higher epoch; "
        "commands never interleave",
        "none",
        "fault 'busy' in the second: another cloud controls the robot; "
        "cloudrc_datagrams_total{outcome=busy}, cloudrc_sessions_refused_total",
        _two_clouds,
    ),
    Scenario(
        37,
        "bad-configuration",
        "unknown keys, wrong units, limits of 0, infinity and NaN",
        "refused with the path of the key and the nearest known one, exit code 2",
        "nothing",
        "one line; no metric, there is no process",
        _configuration,
    ),
    Scenario(
        38,
        "secret-wrong-or-rotated",
        "no key, or another one, in cloud; a rotation that keeps the old key, and one without",
        "no session, GROUND; one short HOLD with the old key kept; without it HOLD until both "
        "have the new key",
        "none",
        "fault 'key' in world, 'no_session' in cloud after 5 s, "
        "cloudrc_datagrams_total{outcome=tag}",
        _secrets,
    ),
)
