"""The process of a hand-in: it calls the student's functions, and returns their results alone.

The check runs in another process, flies there, and computes the points, so that a student's file
cannot score itself. A request of the check is a line of JSON, `[number, calls]`; an answer is
`[number, result, error]`. A call is `[name, method, arguments]`: the method "build" makes the
plug-in `name`, such as "predictor 3", and the other methods are those of the plug-in.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sys
import traceback
from collections.abc import Iterable, Mapping, Sequence, Set
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from cloudrc import plugins
from cloudrc.cloud.estimators import DelaySample
from cloudrc.errors import CloudrcError, PlacedError, describe_error
from cloudrc.messages import Command, Odometry, Setpoint
from cloudrc.outside.values import RESULT, WHOLE, InvalidValueError

FILES = {
    "estimator": "delay_estimator.py",
    "predictor": "predictor.py",
    "controller": "controller.py",
}
"""Part -> the student's file."""
TYPES: dict[str, tuple[Any, ...]] = {
    "estimator update": (DelaySample,),
    "predictor observe": (Odometry,),
    "predictor commanded": (Command,),
    "predictor predict": (Odometry, None),
    "controller update": (Odometry, Setpoint, None),
}
"""Part and method -> the types of the arguments that are named tuples; None for a number."""
PARTS_MAX = 100
"""Largest number of parts of a result, such as the 5 parts of an odometry."""
Call: TypeAlias = Sequence[Any]
"""The name of a plug-in, a method, and the arguments; for "build", a mapping of parameters."""


class HandIn:
    """The student's files in a folder, and the plug-ins that were built from them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._built: dict[str, Any] = {}
        self._process = os.getpid()

    def answer(self, calls: Iterable[Call]) -> tuple[Any, str]:
        """Carry out calls in order; return the result of the last one, and the first error or "".

        The result consists of numbers and lists.
        """
        result, first = None, ""
        for name, method, arguments in calls:
            part = name.partition(" ")[0]
            try:
                result = self._carry_out(name, part, method, arguments)
            except BaseException as error:  # a student's file may raise anything
                first = first or self._explain(error, part)
            if os.getpid() != self._process:  # a file called os.fork(): one process answers
                os._exit(0)
        return result, first

    def _carry_out(self, name: str, part: str, method: str, arguments: Any) -> Any:
        if method == "build":
            path = str(self._folder / FILES[part])
            parameters = {key: to_tuple(value) for key, value in arguments.items()}
            self._built[name] = plugins.load(f"{part}s", path, **parameters)
            return None
        kinds = TYPES.get(f"{part} {method}", (None,) * len(arguments))
        given = [
            value if kind is None else kind(*to_tuple(value))
            for kind, value in zip(kinds, arguments, strict=True)
        ]
        result = getattr(self._built[name], method)(*given)
        return to_plain(result) if method == plugins.METHODS[f"{part}s"] else None

    def _explain(self, error: BaseException, part: str) -> str:
        """Describe an error; begin with FILE:LINE, the place in the student's files that failed."""
        while isinstance(error, CloudrcError) and error.__cause__ is not None:
            error = error.__cause__
        if isinstance(error, PlacedError):
            return str(error)
        trace = traceback.extract_tb(error.__traceback__)
        places = [(each.filename, each.lineno) for each in trace]
        if isinstance(error, SyntaxError):
            places.append((str(error.filename), error.lineno))
        places = [place for place in places if place[0].startswith(f"{self._folder}{os.sep}")]
        text = str(error) if isinstance(error, CloudrcError) else describe_error(error)
        if places:
            text = f"{places[-1][0]}:{places[-1][1]}: {text}"
        else:
            text = f"{find_method(self._folder, part)}: {text}"
        return text.replace(f"{self._folder}{os.sep}", "")


def find_method(folder: Path, part: str) -> str:
    """Return FILE:LINE of the method that gives the result of a part; FILE if there is none."""
    name, method = FILES[part], plugins.METHODS[f"{part}s"]
    path = folder / name
    if not path.is_file():
        return name
    before, found, _ = path.read_text(errors="replace").partition(f"def {method}(")
    return f"{name}:{before.count(chr(10)) + 1}" if found else name


def to_plain(value: Any) -> Any:
    """Convert a plug-in's result to numbers and lists; raise an InvalidValueError if it is none.

    The check decides whether numbers and shapes are right.
    """
    if type(value) is float:  # the usual case is fast
        return value
    is_list = isinstance(value, Iterable) and not isinstance(value, str | bytes | Set | Mapping)
    if is_list and getattr(value, "shape", None) != ():
        return [to_plain(each) for each in islice(value, PARTS_MAX)]
    with suppress(InvalidValueError):
        return WHOLE.of(value, "result")
    return RESULT.of(value, "result")


def to_tuple(value: Any) -> Any:
    """Convert lists to tuples, also inside lists."""
    return tuple(map(to_tuple, value)) if isinstance(value, list) else value


def serve(folder: Path, requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer the requests of the check until it closes its end; work in the hand-in's folder.

    So a file may open one beside it by its name, wherever the check was started.
    """
    os.chdir(folder)
    hand_in = HandIn(folder)
    for line in requests:
        number, calls = json.loads(line)
        answer = json.dumps([number, *hand_in.answer(calls)])
        answers.write(answer.encode() + b"\n")
        answers.flush()


def end_with_check() -> None:
    """Start a process that kills this process group as soon as the check closes its end of stdin.

    SIGKILL closes it, too. The process is another one, because a student's loop in C lets no other
    thread run.
    """
    if os.fork():
        return
    os.close(1)  # the answers end with the process of the student's files
    check = select.poll()
    check.register(0, 0)  # an end that closes is always reported
    check.poll()
    os.killpg(0, signal.SIGKILL)


def limit_time(limit: int) -> None:
    """End this process after `limit` [s] of processor time: SIGXCPU or, if blocked, SIGKILL."""
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))


if __name__ == "__main__":  # the folder, the limit of processor time [s]
    end_with_check()
    limit_time(int(sys.argv.pop(2)))
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    for standard in (0, 1, 2):  # what the student's files print is no answer
        os.dup2(nowhere, standard)
    serve(Path(sys.argv.pop(1)), requests, answers)
    os._exit(0)  # the student's files may have started threads
