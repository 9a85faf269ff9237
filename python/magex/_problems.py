"""What can be wrong, as exceptions whose text is the sentence that a person reads."""

from __future__ import annotations

import os
import sysconfig
import traceback

import numpy as np

from magex._wire import environment_pb2 as pb

Kind = pb.EnvironmentProblemKind
RAISED, BROKE_ITS_WORD, REQUEST = (
    pb.ENVIRONMENT_PROBLEM_KIND_RAISED,
    pb.ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD,
    pb.ENVIRONMENT_PROBLEM_KIND_REQUEST,
)

_HERE = os.path.dirname(os.path.abspath(__file__)) + os.sep
_INSTALLED = tuple({sysconfig.get_path(name) + os.sep for name in ("stdlib", "purelib", "platlib")})


class Refused(Exception):
    """The environment cannot be served as it is; the text names the field and the remedy."""


class Problem(Exception):
    """One request failed. The stream stays usable."""

    def __init__(self, kind: Kind, message: str, world: int | None = None) -> None:
        super().__init__(message)
        self.kind = kind
        self.message = message
        self.world = world


class StateProblem(Problem):
    """state() failed, without which a team can be trained too."""


def request(message: str) -> Problem:
    """The caller's fault."""
    return Problem(REQUEST, message)


def broke(world: int, agent: str | None, field: str, expected: object, seen: object) -> Problem:
    """The environment's fault: it returned what its description does not allow."""
    place = f'world {world}, agent "{agent}"' if agent is not None else f"world {world}"
    return Problem(BROKE_ITS_WORD, f"{place}, {field}: expected {expected}, seen {seen}", world)


def raised(error: BaseException, during: str, world: int | None = None) -> Problem:
    """The environment's fault: it raised an exception."""
    place = f"world {world}, {during}" if world is not None else during
    return Problem(RAISED, f"{place}: {describe(error)}", world)


def describe(error: BaseException) -> str:
    """Type, text and the place that its author can change."""
    text = " ".join(str(error).split())
    if len(text) > 500:
        text = text[:500] + "…"
    line = frame(error)
    return f"{type(error).__name__}: {text}" + (f" ({line})" if line else "")


def frame(error: BaseException) -> str:
    """file:line of the last frame in code of the user's; of the last frame at all if there is none."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith((_HERE, "<"))]
    own = [f for f in frames if not f.filename.startswith(_INSTALLED)]
    chosen = own or frames
    return f"{chosen[-1].filename}:{chosen[-1].lineno}" if chosen else ""


def state_problem(problem: Problem) -> StateProblem:
    """The same, with its remedy."""
    return StateProblem(problem.kind, f"{problem.message}; serve with state=False if it is of no use", problem.world)


def short(value: object, limit: int = 120) -> str:
    """A value as a person wants to see it in a sentence."""
    if isinstance(value, np.generic):
        value = value.item()
    text = " ".join(repr(value).split())
    return text if len(text) <= limit else text[:limit] + "…"


def names(values: object, limit: int = 8) -> str:
    """Names of agents, or keys, sorted and not too many."""
    texts = sorted(f'"{v}"' if isinstance(v, str) else repr(v) for v in values)  # type: ignore[attr-defined]
    more = f" and {len(texts) - limit} more" if len(texts) > limit else ""
    return (", ".join(texts[:limit]) + more) or "none"
