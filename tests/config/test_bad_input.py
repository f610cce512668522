"""Bad input gives one message with place, reason and remedy, for all problems of a file at once."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from cloudrc.config.load import load_experiment, load_profile
from cloudrc.errors import BadInputError


def refused(path: Path, text: str, *settings: str) -> str:
    path.write_text(text, "utf-8")
    with pytest.raises(BadInputError) as caught:
        load_experiment(path, settings)
    assert caught.value.exit_code == 2
    return str(caught.value).replace(f"{path.parent}/", "")


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    return tmp_path / "mine.yaml"


def test_all_problems_are_listed_with_their_lines(mine: Path) -> None:
    text = refused(
        mine,
        "seed: one\n"
        "guard: {speed_max: 2}\n"
        "link:\n"
        "  profile: paper-p2\n"
        "  uplink:\n"
        "    delay_ms: -3\n"
        "    loss: 1.2\n"
        "cloud:\n"
        "  predictor: last_sampel\n"
        "  controller: {name: pid, sped_max: 2}\n"
        "world: {scene: pipe}\n",
    )
    first, *rest = text.splitlines()
    assert first == "mine.yaml has 7 problems:"
    assert sorted(line.strip() for line in rest) == sorted([
        "mine.yaml:1: seed: 'one': must be a whole number >= 0 and < 9007199254740992",
        "mine.yaml:2: guard.speed_max: unknown key; did you mean speed_max_mps [m/s]?",
        "mine.yaml:6: link.uplink.delay_ms: -3: must be a number >= 0 [ms]",
        "mine.yaml:7: link.uplink.loss: 1.2: "
        "must be a number >= 0 and <= 1 or a mapping of keys",
        "mine.yaml:9: cloud.predictor: no predictor named 'last_sampel'; available: "
        "commanded_velocity, constant_acceleration, constant_velocity, last_sample; "
        "did you mean last_sample?",
        "mine.yaml:10: cloud.controller.sped_max: unknown key; did you mean speed_max?",
        "mine.yaml:11: world.scene: no scene named 'pipe'; available: empty, pipes; "
        "did you mean pipes?",
    ])  # fmt: skip


@pytest.mark.parametrize(
    ("key", "values", "bounds"),
    [
        ("command_age_max_ms", ("0", "1e-9", "1e300", "true", "x"), ">= 1 and <= 10000 or null"),
        ("speed_max_mps", ("0", "1e-320", "1e300"), ">= 0.01 and <= 10 or null"),
        ("acceleration_max_mps2", ("0", "1e-9", "1e300"), ">= 0.1 and <= 100"),
        ("yaw_rate_max_radps", ("0", "1e-9", "1e300"), ">= 0.01 and <= 10"),
        ("hold_max_s", ("0", "1e-10", "1e30"), ">= 0.1 and <= 3600"),
    ],
)
def test_guard_limits_outside_their_bounds_are_one_problem(
    mine: Path, key: str, values: tuple[str, ...], bounds: str
) -> None:
    for value in values:
        text = refused(mine, "mission: hover\n", f"guard.{key}={value}")
        (line,) = text.splitlines()
        assert line.startswith(f"--set: guard.{key}: "), line
        assert f"must be a number {bounds}" in line


def test_a_profile_cannot_disable_the_age_limit(tmp_path: Path) -> None:
    path = tmp_path / "slow.yaml"
    for age in ("0", "1e-9", "1e9"):
        path.write_text(f"command_age_max_ms: {age}\n")
        with pytest.raises(BadInputError, match=r"command_age_max_ms: .* >= 1 and <= 10000"):
            load_profile(path)


def test_a_huge_dwell_is_refused(mine: Path) -> None:
    text = refused(mine, "mission: {waypoints: [{position_m: [0, 0, 1], dwell_s: 1.0e+308}]}\n")
    assert "dwell_s: 1e+308: must be a number >= 0 and <= 1000000 [s]" in text


def test_at_most_fifty_problems_are_listed(mine: Path) -> None:
    points = ", ".join(["{position_m: [0, 0, 1], dwell_s: -1}"] * 2000)
    text = refused(mine, f"mission: {{waypoints: [{points}]}}\n")
    assert "mine.yaml has 2000 problems:" in text
    assert text.endswith("and 1950 more")
    assert len(text.splitlines()) == 52


@pytest.mark.parametrize(
    ("typo", "meant"),
    [
        ("link: {uplink: {delay: 3}}", "did you mean delay_ms [ms]?"),
        ("link: {uplink: {delay_s: 3}}", "did you mean delay_ms [ms]?"),
        ("delay_ms: 3", "did you mean link.uplink.delay_ms?"),
        ("missoin: pipes", "did you mean mission?"),
        ("zzz: 3", "known here: name, description, seed, mission"),
    ],
)
def test_an_unknown_key_gets_a_suggestion(mine: Path, typo: str, meant: str) -> None:
    assert meant in refused(mine, typo)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("seed: 1\nseed: 2", "mine.yaml:2: the key 'seed' is given twice"),
        ("seed: [", "mine.yaml:"),
        ("", "mine.yaml: must be a mapping"),
        ("- 1", "mine.yaml: must be a mapping"),
        ("seed: !!python/name:os.system x", "mine.yaml:1"),
        ("[" * 60, "nested more than 50 deep"),
        ("a: &a [*a]", "a value contains itself"),
        ("a: " + "9" * 5000, "not readable"),
        ("world: 3", "mine.yaml:1: world: 3: must be a mapping"),
        ("mission: 3", "mine.yaml:1: mission: 3: must be text or a mapping"),
        ("link: {uplink: 3}", "link.uplink: 3: must be a mapping"),
        ("cloud: [pid]", "cloud: ['pid']: must be a mapping"),
        ("tunnel: {order: newset}", "did you mean newest?"),
        ("link: {profile: paper-p9}", "link.profile: no profile named 'paper-p9'; available: 5g"),
        ("name: ../../x", "name: '../../x': must be text without slashes"),
        ("mission: ./nowhere.yaml", "mission: no such file:"),
    ],
)
def test_an_invalid_file_is_one_line(mine: Path, text: str, reason: str) -> None:
    found = refused(mine, text)
    assert reason in found
    assert "\n" not in found


def test_nested_aliases_do_not_exhaust_memory(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.config.document._MAX_VALUES", 10_000)
    levels = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 10)]
    assert "more than 10000 values" in refused(mine, "\n".join(["a0: &a0 [1]", *levels]))


def test_an_unreadable_file_is_reported(tmp_path: Path) -> None:
    for name, reason in ((tmp_path / "no.yaml", "no such file"), (tmp_path / ".", "cannot be read"),
                         ("papr", "did you mean paper?")):  # fmt: skip
        with pytest.raises(BadInputError, match=reason.replace("?", r"\?")):
            load_experiment(f"{name}/" if reason == "cannot be read" else name)
    (tmp_path / "latin.yaml").write_bytes(b"description: \xff\xfe")
    with pytest.raises(BadInputError, match="is not UTF-8 text"):
        load_experiment(tmp_path / "latin.yaml")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nosuch.yaml", "nosuch.yaml; names of shipped experiments: hover, paper"),
        ("no/papper.yaml", "did you mean paper?"),
    ],
)
def test_a_missing_file_lists_the_shipped_names(name: str, words: str) -> None:
    with pytest.raises(BadInputError, match=r"^no such file: ") as caught:
        load_experiment(name)
    assert words in str(caught.value)


def test_a_missing_parameter_is_reported_once(mine: Path) -> None:
    (mine.parent / "strict.py").write_text("def build(share: float): ...")
    text = refused(mine, "seed: 1\ncloud: {predictor: ./strict.py}\n")
    assert text == "mine.yaml:2: cloud.predictor.share: is missing; must be a number"


@pytest.mark.parametrize(
    "text", ["seed", "=3", "a..b=1", ".=1", "seed=[", "seed=[1] # x", 'name="a" # b"']
)
def test_an_invalid_setting_is_refused(text: str) -> None:
    with pytest.raises(BadInputError, match="--set"):
        load_experiment("paper", [text])


def test_a_key_that_is_set_twice_is_refused() -> None:
    with pytest.raises(BadInputError, match="--set seed: is set twice; keep one of them"):
        load_experiment("paper", ["seed=1", "name=x", "seed=2"])


def test_an_index_beyond_the_end_is_refused() -> None:
    with pytest.raises(BadInputError, match="entries 0 to 6; use one of these, or 7 to append"):
        load_experiment("paper", ["mission.waypoints.9.dwell_s=1"])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("uplink: {delay_ms: -1}", "mine.yaml:1: uplink.delay_ms: -1: must be a number >= 0 [ms]"),
        ("uplink: {loss: 1.2}", "uplink.loss: 1.2: must be a number >= 0 and <= 1"),
        ("uplink: {loss: {bad_start: .1, bad_end: 0}}", "uplink.loss: bad_end must be above 0"),
        ("uplink: {loss: {bad_start: .1}}", "uplink.loss.bad_end: is missing; must be a number"),
        ("uplink: {jitter_ms: 3, distribution: gauss}", "'normal', 'pareto' or 'table'"),
        ("uplink: {distribution: table}", "uplink: distribution: table needs the key table"),
        ("uplink: {table: nowhere.csv}", "uplink.table: trace "),
        ("uplink: {changes: [{at_s: 5}, {at_s: 5}]}", "uplink.changes: at_s must rise: entry 1"),
        ("uplink: {queue_packets: 1.5}", "must be a whole number >= 1"),
        ("uplink: {keep_order: yes}", "must be true or false"),
        ("uplink: {trace: nowhere.csv}", "uplink.trace: trace "),
        ("delay_ms: 3", "delay_ms: unknown key; did you mean uplink.delay_ms?"),
        ('"<": 3', "<: unknown key; known here: "),
        ('uplink: {"<chance>": 3}', "uplink.<chance>: unknown key; "),
    ],
)
def test_an_invalid_profile_is_refused_with_the_reason(mine: Path, text: str, reason: str) -> None:
    mine.write_text(text)
    with pytest.raises(BadInputError) as caught:
        load_profile(mine)
    assert reason in str(caught.value)
    with pytest.raises(BadInputError) as caught:
        load_experiment("paper", [f"link.profile={mine}"])
    assert str(caught.value).startswith("--set: link.profile: ")
    assert reason in str(caught.value)


def test_an_unsorted_trace_is_refused_with_its_key(tmp_path: Path) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text("time_s,delay_ms\n1,20\n0,20\n")
    with pytest.raises(BadInputError, match=r"link\.uplink\.trace: .*line 3"):
        load_experiment("paper", [f"link.uplink.trace={trace}"])


def test_deep_nesting_is_refused(mine: Path) -> None:
    found = refused(mine, "[" * 100_000)
    assert found.startswith("mine.yaml:1: ")
    assert "nest" in found  # a newer libyaml has its own limit and message


@pytest.mark.parametrize(
    ("waypoints", "reason"),
    [
        ("[]", "mission.waypoints: none given; give at least one, or steps"),
        ("[{position_m: [.nan, 0, 1]}]", "waypoints.0.position_m.0: nan: must be finite"),
        ("[{position_m: [0, 1]}]", "position_m.2: is missing; must be a number"),
        ("[{position_m: [0, 0, 1, 2]}]", "at most 3 entries"),
        ("[{tolerance_m: 1}]", "position_m: is missing; must be a list of 3 numbers [m]"),
        ("[{position_m: [0, 0, 3]}]",
         "[0, 0, 3]: beyond the fence, or nearer than the guard flies: "
         "x -2.8 to 9, y -8.3 to 5.3, z 0.35 to 2.3 [m]; nearest legal point found: [0.3, 0, 2.3]"),
        ("[{position_m: [0.5, 0, .7]}, {position_m: [-.6, 0, .8]}]",
         "waypoints.1.position_m: [-0.6, 0, 0.8]: the robot would be within 0.04 m of the wall of "
         "pipe_1; nearest legal point found: [0.08, 0, 0.8]"),
    ],
)  # fmt: skip
def test_an_invalid_mission_is_refused_with_the_reason(
    mine: Path, waypoints: str, reason: str
) -> None:
    found = refused(mine, f"mission: {{waypoints: {waypoints}}}")
    assert reason in found
    assert found.startswith("mine.yaml:1: mission.waypoints")


def test_100_000_waypoints_are_refused_quickly(tmp_path: Path) -> None:
    mission = tmp_path / "long.yaml"
    mission.write_text("waypoints:\n" + "- {position_m: [0.5, 0.0, 0.7], dwell_s: 0}\n" * 100_000)
    start = time.perf_counter()
    with pytest.raises(BadInputError, match=r"long\.yaml: waypoints: 100000: at most 10000; split"):
        load_experiment("paper", [f"mission={mission}"])
    assert time.perf_counter() - start < 2
