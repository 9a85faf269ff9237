"""Checks environments that hold all worlds in arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from magex import _probe
from magex._environment import Environment
from magex._layout import Batch, Layout
from magex._problems import Problem, Refused, describe, short
from magex._report import Report
from magex._vector import VectorWorlds


def check_vector(environment: Environment, layout: Layout, report: Report, seed: int, steps: int) -> None:
    """Plays some worlds side by side; what the arrays must look like is checked as it is in training."""
    report.check("reset", "step", "observations", "finite", "aliasing", "other seed")
    if layout.masks:
        report.check("masks")
    if layout.state_width:
        report.check("state")
    if layout.steps_max:
        report.check("limits")
    count = min(4, layout.worlds_max or 4)
    worlds = environment.worlds()
    assert isinstance(worlds, VectorWorlds)
    try:
        _play(layout, report, worlds, [seed + w for w in range(count)], steps)
        _pictures(layout, report, worlds)
    except (Problem, Refused) as problem:
        report.add(_rule_of(str(problem)), f"after {report.episodes} episodes and {report.steps} steps: {problem}")
    worlds.close()
    try:
        again = environment.worlds()
        again.reset([seed])
        again.close()
    except (Problem, Refused) as problem:
        report.add("make", f"a second environment, after close() of the first: {problem}")
    except Exception as error:
        report.add("make", f"a second environment, after close() of the first: {describe(error)}")


def _play(layout: Layout, report: Report, worlds: VectorWorlds, seeds: list[int], steps: int) -> None:
    watch = _Watch(layout, report)
    count = len(seeds)
    report.episodes += count
    batch = worlds.reset(seeds)
    watch.returned(worlds, batch, "reset")
    alike = count > 1 and _alike(batch)
    generator = np.random.default_rng(5)
    length = np.zeros(count, np.int64)
    cut = wrong = 0
    next_seed = seeds[-1] + 1
    begun = report.steps
    rounds = 0
    while report.steps - begun < steps:
        rounds += 1
        again: dict[int, int] = {}
        actions = np.zeros((count, len(layout.agents), layout.actions.size))
        # The same numbers for all worlds: what differs comes from the seed.
        state = generator.bit_generator.state
        for w in range(count):
            generator.bit_generator.state = state
            if batch.active[w].any():
                actions[w] = _probe.random_actions(layout, generator, None if batch.masks is None else batch.masks[w])
            else:
                again[w] = next_seed
                next_seed += 1
                report.episodes += 1
        generator.random()
        batch = worlds.step(actions.astype(np.int64) if layout.actions.discrete else actions, again)
        where = f"step {rounds}"
        watch.unchanged(where)
        watch.returned(worlds, batch, where)
        length += 1
        length[list(again)] = 0
        alike = alike and _alike(batch)
        report.steps += count - len(again)
        over = ~batch.active.any(axis=1) & (batch.terminated | batch.truncated).any(axis=1)
        for w in np.flatnonzero(over).tolist():
            if layout.steps_max and length[w] == layout.steps_max:
                cut += 1
                wrong += int(batch.terminated[w].any() and not batch.truncated[w].any())
        late = batch.active.any(axis=1) & (length == layout.steps_max + 1)
        if layout.steps_max and late.any():
            w = int(np.argmax(late))
            report.add(
                "limits", f"world {w}: the episode goes on after step {layout.steps_max}, its limit; end it, or correct the limit"
            )
    if wrong and wrong == cut:
        text = (
            f"{wrong} episodes end at their limit of {layout.steps_max} steps with terminated; that is a truncation, after which "
        )
        report.add("limits", text + "the rest of the episode still has a value", warning=wrong < 2)
    if alike:
        report.add(
            "other seed", f"{count} worlds with the seeds {seeds[0]} to {seeds[-1]} and equal actions are equal", warning=True
        )


def _alike(batch: Batch) -> bool:
    return bool((batch.observations == batch.observations[:1]).all() and (batch.rewards == batch.rewards[:1]).all())


class _Watch:
    """The environment's own array of observations: its bounds, and whether it is written to after it was returned."""

    def __init__(self, layout: Layout, report: Report) -> None:
        self.layout, self.report = layout, report
        self.kept: tuple[str, np.ndarray, np.ndarray] | None = None

    def returned(self, worlds: VectorWorlds, batch: Batch, where: str) -> None:
        raw: Any = worlds.last
        self.kept = (where, raw, raw.copy()) if isinstance(raw, np.ndarray) else None
        for i, codec in enumerate(self.layout.observations):
            if codec.shape is None:
                continue
            seen = batch.observations[:, i, : codec.width]
            low, high = np.ravel(codec.inner.low), np.ravel(codec.inner.high)
            outside = ((seen < low) | (seen > high)) & (batch.active | batch.terminated | batch.truncated)[:, i, None]
            if outside.any():
                w, at = (int(x) for x in np.argwhere(outside)[0])
                self.report.add(
                    "observations",
                    f'{where}, world {w}, agent "{self.layout.agents[i]}": number {at} is {seen[w, at]}, and its bounds are '
                    f"{low[at]} to {high[at]}",
                )

    def unchanged(self, where: str) -> None:
        if self.kept is not None and self.kept[1].tobytes() != self.kept[2].tobytes():
            self.report.add(
                "aliasing", f"{self.kept[0]}: the array of observations was changed by {where}; return a copy", warning=True
            )


def _pictures(layout: Layout, report: Report, worlds: VectorWorlds) -> None:
    if not layout.renders:
        return
    report.check("pictures")
    picture = worlds.render(0)
    if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.shape[2] not in (3, 4) or picture.dtype != np.uint8:
        report.add("pictures", f"render(0) returns {short(picture)}; return an array [height, width, 3] of uint8")


def _rule_of(sentence: str) -> str:
    """Training's sentence under the rule that it belongs to."""
    for word, rule in (
        ("mask", "masks"),
        ("states()", "state"),
        ("state()", "state"),
        ("finite", "finite"),
        ("reward", "rewards"),
        ("terminated", "ends"),
        ("truncated", "ends"),
        ("reset", "reset"),
        ("observations", "observations"),
    ):
        if word in sentence:
            return rule
    return "step"
