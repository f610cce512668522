# SPDX-License-Identifier: Apache-2.0

"""Check and complete how an environment and its policy are connected."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, cast

import gymnasium
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space, iterate

from cloudrc.base import plugins
from cloudrc.base.outside.refusal import check_names, naming
from cloudrc.base.outside.values import InvalidValueError, Quantity
from cloudrc.gym.doubts import LinkWarning
from cloudrc.gym.executors import Executor
from cloudrc.gym.lane import DATAGRAMS, DELIVERIES, Lane, WaitingLane
from cloudrc.gym.links import Links, choose_link
from cloudrc.gym.loop import FIRST, RemoteLoop, Settings
from cloudrc.gym.memory import Remembering
from cloudrc.gym.step import FILM, WAY, StepTime, layers
from cloudrc.gym.values import checker, copied, neutral, size_of
from cloudrc.link.library import PACKET_BYTES, LinkProfile

if TYPE_CHECKING:
    from cloudrc.config.camera import CodecConfig
    from cloudrc.gym.codec import ObservationCodec

SIZE = Quantity("bytes", 0, 1_000_000_000, whole=True)
"""Size of a message."""
PACKET = replace(SIZE, ge=1)
"""Most bytes of a packet."""
COUNTS = {
    "chunk": (Quantity(ge=1, le=10_000, whole=True), "the number of actions in an answer"),
    "observation_bytes": (SIZE, "a number of bytes"),
    "action_bytes": (SIZE, "a number of bytes"),
    "packet_bytes": (PACKET, "the most bytes of a packet"),
}
"""Option -> which whole numbers it takes, and what they mean."""
COMPUTE = Quantity("s", 0.0, 3600.0)
"""Time for an answer."""
AGE = Quantity("s", 0.0)
"""Age of an action."""
WAIT = 0.05
"""How long a robot waits in a step for an answer, as a share of the step."""
CODECS = {"jpeg": "jpeg:70", "h264": "h264:800"}
"""Codec of images -> an example with its number."""
ANSWER = "answer"
"""Start of an episode: the robot waits for the first answer."""


class Options(TypedDict, total=False):
    """Further arguments of `Networked`, which describes them."""

    compute: float | tuple[float, float]
    answer_within: float | None
    deadline: float | None
    chunk: int | None
    executor: str | Path | Mapping[str, Any]
    hold: str
    start: Any
    observation_bytes: int | None
    action_bytes: int | None
    delivery: str
    packet_bytes: int
    codec: str | None
    observe_age: bool
    observe_actions: int
    observe_step: bool
    answers: str
    acknowledge: str | None


DEFAULTS: Options = {
    "compute": 0.0,
    "answer_within": None,
    "deadline": None,
    "chunk": None,
    "executor": "newest",
    "hold": "repeat",
    "start": None,
    "observation_bytes": None,
    "action_bytes": None,
    "delivery": DATAGRAMS,
    "packet_bytes": PACKET_BYTES,
    "codec": None,
    "observe_age": False,
    "observe_actions": 0,
    "observe_step": False,
    "answers": "arrival",
    "acknowledge": None,
}
ARGUMENTS = ("env", "link", "seed", "dt", "stream", *DEFAULTS)
"""Names of the arguments of `Networked` and `NetworkedVector`."""


def read_options(what: str, given: Options) -> Options:
    """Read the options of the environment `what`; those that are not given have their defaults."""
    check_names(f"argument of {what}", given, ARGUMENTS)
    read: dict[str, Any] = {**DEFAULTS, **given}
    check_names("hold", [read["hold"]], ("repeat", "start"))
    check_names("delivery", [read["delivery"]], DELIVERIES)
    check_names("answers", [read["answers"]], ("arrival", "step"))
    if read["acknowledge"] is not None:
        check_names("acknowledge", [read["acknowledge"]], ("ideal",))
    for name, (quantity, wanted) in COUNTS.items():
        if read[name] is not None:
            with naming(name, f"None, or {wanted}"):
                read[name] = quantity.of(read[name])
    if read["codec"] is not None:
        read_codec(read["codec"])
    if read["deadline"] is not None:
        with naming("deadline", "None, or the largest age of an action that is no miss"):
            read["deadline"] = AGE.of(read["deadline"])
    return cast(Options, read)


def read_codec(text: str, place: str = "codec") -> CodecConfig:
    """Read a codec of images, such as "jpeg", "jpeg:70" or "h264:800"; `place` names it."""
    from cloudrc.config.camera import KBIT, QUALITY, CodecConfig  # of pydantic, which takes time

    name, colon, number = str(text).partition(":")
    numbers = {"jpeg": ("quality", QUALITY), "h264": ("kbit", KBIT)}
    check_names("codec", [name], numbers, f"{place}: ")
    key, quantity = numbers[name]
    with naming(f"{place} {text}", f"{name} or {name}:{key.upper()}, such as {CODECS[name]}"):
        return CodecConfig(codec=cast(Any, name), **({key: quantity.read(number)} if colon else {}))


def _open_codec(
    space: gymnasium.Space[Any], given: str | None, dt: float
) -> ObservationCodec | None:
    """Return what encodes observations of a space, one per `dt` [s] at most; None: nothing."""
    if given is None:
        return None
    from cloudrc.gym.codec import ObservationCodec, shapes_of

    codec, shapes = read_codec(given), [*shapes_of(space)]
    with naming(f"codec {given}"):
        if not shapes:
            raise InvalidValueError(
                f"there is no image to encode: no uint8 array of shape (height, width, 3) in "
                f"{_form(space)}; leave it out"
            )
        if codec.codec == "h264" and any(rows % 2 or columns % 2 for rows, columns, _ in shapes):
            raise InvalidValueError(
                f"an image has the shape {shapes[0]}, and H.264 needs even numbers of rows and "
                "columns; choose jpeg"
            )
    return ObservationCodec(space, codec, dt)


def _form(space: gymnasium.Space[Any]) -> str:
    """Describe a space by the shapes and types of its arrays, such as "Box(4,) float32"."""
    kind = type(space).__name__
    if isinstance(space, gymnasium.spaces.Dict):
        return f"{kind}({', '.join(f'{key}: {_form(part)}' for key, part in space.items())})"
    if isinstance(space, gymnasium.spaces.Tuple):
        return f"{kind}({', '.join(map(_form, space))})"
    return f"{kind}{space.shape} {space.dtype}" if space.shape else kind


def _usual_size(space: gymnasium.Space[Any], options: Options) -> int:
    size = options["observation_bytes"]
    if size is None:
        return FIRST if options["codec"] else size_of(space.sample())
    return size


def _usual_answer(action: Any, options: Options) -> int:
    size = options["action_bytes"]
    return size_of(action) * (options["chunk"] or 1) if size is None else size


def connect(
    spaces: tuple[gymnasium.Space[Any], gymnasium.Space[Any]],
    dt: float,
    link: Links,
    seed: int,
    streams: Iterable[str],
    options: Options,
    *,
    slot: float | None = None,
) -> tuple[list[RemoteLoop], list[LinkProfile]]:
    """Connect a robot of each of the `streams` with its policy; also return the known links.

    `spaces` are those of an observation and of an action; `dt` is the time of a step [s]. All
    `options` are there, as `read_options` returns them. With a `slot`, observations wait for a
    channel that sends each for so long [s].
    """
    observations, actions = spaces
    start, chunk = options["start"], options["chunk"]
    waits = isinstance(start, str) and start == ANSWER
    if start is None or waits:
        start = neutral(actions)
    else:
        checker(actions, f"as start= an action, or {ANSWER!r}")(start)
    settings = Settings(
        seed=seed,
        dt=dt,
        answer_within=_read_wait(options["answer_within"], dt),
        deadline=options["deadline"],
        compute=compute_times(options["compute"]),
        repeats=options["hold"] == "repeat",
        start=copied(start),
        waits=waits,
        observation_bytes=_usual_size(observations, options),
        action_bytes=_usual_answer(start, options),
        delivery=options["delivery"],
        packet_bytes=options["packet_bytes"],
        answers_each_tick=options["answers"] == "step",
        acknowledges=options["acknowledge"] is not None,
        slot=slot or 0.0,
    )
    choose, known = choose_link(link, seed)
    check, loops = checker(actions, "one action, or None"), list[RemoteLoop]()
    for stream in streams:
        own, is_ours = find_executor(options["executor"], actions, chunked=chunk is not None)
        memory, judge = Remembering(spaces, options, settings.start), None if is_ours else check
        more: Any = {"judge": judge, "lane": Lane if slot is None else WaitingLane}
        more["codec"] = _open_codec(observations, options["codec"], dt)
        loops.append(RemoteLoop(settings, choose, own, memory, stream, **more))
    return loops, known


def check_kind(env: Any, kind: type, name: str) -> None:
    """Raise an error about an environment of another `kind`, gymnasium's class `name`."""
    if isinstance(env, kind):
        return
    who = f"{type(env).__name__} is no {name} of gymnasium"
    if isinstance(env, gymnasium.Env | VectorEnv):
        other = "NetworkedVector" if isinstance(env, VectorEnv) else "Networked"
        raise InvalidValueError(f"{who}; give it to {other}")
    makers = {each.__module__.partition(".")[0] for each in type(env).__mro__}
    if "pettingzoo" in makers:
        who += " but one of PettingZoo, in which several agents act"
    raise InvalidValueError(f"{who}; wrap what one robot sees and does in a gymnasium.Env")


def warn_of(
    env: Any,
    loop: RemoteLoop,
    links: Sequence[LinkProfile],
    step: StepTime,
    count: int | None,
) -> None:
    """Warn whoever wraps an environment, if its episodes make no sense or its step is a guess.

    `links` are those that are known; `count` is the number of actions in an answer, None for one.
    """
    limits = [each.spec.max_episode_steps for each in layers(env) if each.spec]
    longest = min(filter(None, limits), default=inf)
    texts = list[str]()
    if not loop.follows_first:
        texts = [text for link in links for text in loop.doubts(link, count or 1, longest)]
    if not links or loop.follows_first:  # a function chooses them, or the size is not known yet
        loop.judge_link = partial(_warn_of_link, loop, count or 1, longest)
    if FILM in step.source:
        texts.append(f"a step takes {step}; if it takes another time, {WAY}")
    for text in dict.fromkeys(texts):
        warnings.warn(text, LinkWarning, stacklevel=4)


def _warn_of_link(loop: RemoteLoop, count: int, longest: float, link: LinkProfile) -> bool:
    texts = [*dict.fromkeys(loop.doubts(link, count, longest))]
    for text in texts:
        warnings.warn(text, LinkWarning, stacklevel=5)
    return bool(texts)


def _read_wait(given: float | None, dt: float) -> float:
    """Return how long the robot waits in a step of `dt` [s] for an answer [s]."""
    if given is None:
        return WAIT * dt
    with naming("answer_within", "how long the robot waits in a step for an answer"):
        return Quantity("s", 0.0, dt).of(given)  # type: ignore[no-any-return]


def compute_times(compute: float | tuple[float, float]) -> tuple[float, float]:
    """Return mean and standard deviation of a compute time [s], given as a number or as both."""
    both = compute if isinstance(compute, tuple | list) else (compute, 0.0)
    with naming("compute", "the time for an answer, or its mean and its standard deviation"):
        mean, deviation = COMPUTE.row(both, 2)
        if deviation and not mean:
            raise InvalidValueError(f"{both}: the mean is 0")
    return mean, deviation


def answer_space(
    space: gymnasium.Space[Any], chunk: int | None
) -> tuple[gymnasium.Space[Any], Callable[[Any], tuple[Any, ...]]]:
    """Return the space of an answer, and a function that copies an answer into its actions."""
    batched = space if chunk is None else batch_space(space, chunk)
    return batched, partial(_split, None if chunk is None else batched)


def _split(batched: gymnasium.Space[Any] | None, answer: Any) -> tuple[Any, ...]:
    answer = copied(answer)
    return (answer,) if batched is None else tuple(iterate(batched, answer))


def describe_answer(chunk: int | None) -> str:
    """Say what an answer is, in words."""
    return "one action" if chunk is None else f"a chunk of {chunk} actions"


def full_name(executor: str | Path) -> str:
    """Return the name of an executor, of which "time-indexed" is a form, or its path."""
    name = str(executor)
    return name if plugins.is_path(name) else name.replace("-", "_")


def find_executor(
    given: str | Path | Mapping[str, Any], actions: gymnasium.Space[Any], *, chunked: bool
) -> tuple[Executor, bool]:
    """Build an executor by name or path, or by a mapping with its `name` and its parameters.

    It executes `actions`, of which an answer is a chunk or a single one.

    Also return whether cloudrc ships it, so that its actions need no judge.
    """
    parameters = dict(given) if isinstance(given, Mapping) else {"name": given}
    found = full_name(parameters.pop("name", ""))
    with naming(f"executor {found!r}"):
        known = plugins.signature("executors", found).parameters
        check_names("parameter", parameters, known)
        executor = plugins.load("executors", found, **parameters)
        if not isinstance(executor, Executor):
            returned = f"build() returned {type(executor).__name__}"
            raise InvalidValueError(f"{returned}; return an Executor of cloudrc.gym.executors")
        if executor.needs_chunk and not chunked:
            text = "it plays chunks of actions; give chunk=, the number of actions in an answer"
            raise InvalidValueError(text)
        if executor.needs_floats and getattr(actions.dtype, "kind", "") != "f":
            raise InvalidValueError(
                f"it computes means of actions, which must be floating-point numbers, and these "
                f"are in {actions}; choose 'time_indexed', or 'async' with aggregate=latest"
            )
    return executor, plugins.find("executors", found).is_shipped
