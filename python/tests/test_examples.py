"""The examples of the repository: what they say about themselves, and that the check finds nothing."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magex._wire import environment_pb2 as pb

FOLDER = Path(__file__).parents[2] / "examples" / "environments"


def example(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def served_by(name: str, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, dict]:
    """What the example gives to `serve`."""
    import magex

    calls: list[tuple[Any, dict]] = []
    monkeypatch.setattr(magex, "serve", lambda make, **options: calls.append((make, options)))
    code = compile((FOLDER / f"{name}.py").read_text(), f"{name}.py", "exec")
    exec(code, {"__name__": "__main__"})
    return calls[0]


@pytest.mark.parametrize(
    ("name", "needs", "agents", "width", "successes"),
    [
        ("spread", "mpe2", 3, 18, False),
        ("spread_continuous", "mpe2", 3, 18, False),
        ("cartpole", "gymnasium", 1, 4, False),
        ("meeting", "pettingzoo", 3, 6, True),
        ("meeting_arrays", "gymnasium", 3, 6, True),
        ("walkers", "Box2D", 3, 31, False),
    ],
)
def test_an_example(served, monkeypatch, name: str, needs: str, agents: int, width: int, successes: bool) -> None:
    pytest.importorskip(needs)
    make, options = served_by(name, monkeypatch)
    stub = served(make, **options)
    description = stub.Describe(pb.DescribeRequest(protocol=1))
    assert (len(description.agents), description.observation_width) == (agents, width)
    assert description.deterministic and description.successes == successes
    reply = stub.Check(pb.CheckRequest(seed=1, steps=100))
    assert not reply.violations, reply
    assert (FOLDER / f"{name}.toml").read_text().startswith(f"# magex train {name}.toml --environment 'python {name}.py'\n")


def test_objects_and_arrays_are_one_task(run, monkeypatch) -> None:
    """The two ways to write it give the same numbers, once they begin in the same cells."""
    pytest.importorskip("pettingzoo")
    objects, arrays = example("meeting").Meeting, example("meeting_arrays").Meeting
    begin = arrays().begin

    class Same(objects):
        def reset(self, seed: Any = None, options: Any = None) -> tuple:
            super().reset(seed=seed)
            self.cells = begin(np.array([seed]))[0]
            return self.observe(), {agent: {} for agent in self.agents}

    one, other = run(Same), run(arrays)
    rng = np.random.default_rng(1)
    seen = [stream.reset(*range(8)) for stream in (one, other)]
    ends, seed = 0, 8
    for _ in range(200):
        a, b = seen
        np.testing.assert_array_equal(a.observations, b.observations)
        np.testing.assert_array_equal(a.rewards, b.rewards)
        assert (a.terminated, a.truncated, a.active, a.successes) == (b.terminated, b.truncated, b.active, b.successes)
        ends += sum(a.successes)
        over = [w for w in range(8) if not any(a.active[w])]
        restarts = {w: seed + w for w in over}
        seed += 8
        # Towards the middle, so that some meet.
        actions = rng.integers(0, 5, (8, 3, 1))
        for w in range(8):
            for i in range(3):
                x, y = a.observations[w, i, :2]
                wanted = [2 if x > 0.5 else 1] * bool(x != 0.5) + [4 if y > 0.5 else 3] * bool(y != 0.5)
                if wanted and rng.random() < 0.8:
                    actions[w, i, 0] = rng.choice(wanted)
        seen = [stream.step(actions, restarts=restarts) for stream in (one, other)]
    assert ends > 5
