"""Finds out by playing whether an episode is a function of its seed and its actions, and whether infos speak of success."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from magex._environment import Environment, Worlds
from magex._layout import Batch, Layout
from magex._problems import StateProblem

STEPS = 200
#: A slow environment plays fewer steps than that: a caller waits for the answer.
SECONDS = 10.0
#: Two episodes with these seeds are played in each of two worlds, in opposite order.
SEEDS = (11, 12)


@dataclass
class Found:
    deterministic: bool
    successes: bool
    steps: int
    #: Where two episodes of one seed first differ, for people.
    difference: str = ""


def random_actions(layout: Layout, rng: np.random.Generator, masks: np.ndarray | None) -> np.ndarray:
    """[N, H or C]: a random choice for every component out of masks [N, H, largest], or random numbers within the bounds."""
    table = layout.actions
    if not table.discrete:
        low = np.where(np.isfinite(table.low), table.low, -1.0)
        high = np.where(np.isfinite(table.high), table.high, 1.0)
        return rng.uniform(low, high)
    allowed = table.allowed if masks is None else masks
    draw = rng.random(allowed.shape) * allowed
    return draw.argmax(axis=2)


def play(environment: Environment, steps: int = STEPS, drop_state: bool = False) -> Found:
    """Plays two seeds in two fresh worlds side by side, and then each seed in the other world.

    Random numbers that worlds share, what an episode leaves behind for the next one and anything drawn without the seed make
    the two episodes of one seed differ.

    drop_state: a state() that fails, where an episode ends for instance, is not sent at all; the critic sees all observations.
    """
    layout = environment.layout()
    try:
        return _play(environment, layout, steps)
    except StateProblem:
        if not drop_state:
            raise
        layout.state_width = 0
        return _play(environment, layout, steps)


def _play(environment: Environment, layout: Layout, steps: int) -> Found:
    if layout.worlds_max == 1:
        return _one_after_another(environment, layout, steps)
    worlds = environment.worlds()
    try:
        first = _episodes(worlds, layout, SEEDS, steps // 2, time.monotonic() + SECONDS / 2)
        second = _episodes(worlds, layout, SEEDS[::-1], len(first[0]) - 1)
    finally:
        worlds.close()
    return _compare(layout, first, second[::-1])


def _one_after_another(environment: Environment, layout: Layout, steps: int) -> Found:
    records = []
    lengths: dict[int, int] = {}
    for order in (SEEDS, SEEDS[::-1]):
        worlds = environment.worlds()
        deadline = None if lengths else time.monotonic() + SECONDS / 2
        try:
            both = [_episodes(worlds, layout, (seed,), lengths.get(seed, steps // 4), deadline)[0] for seed in order]
        finally:
            worlds.close()
        lengths = {seed: len(record) - 1 for seed, record in zip(order, both)}
        records.append(both if order is SEEDS else both[::-1])
    return _compare(layout, records[0], records[1])


def _episodes(
    worlds: Worlds, layout: Layout, seeds: tuple[int, ...], steps: int, deadline: float | None = None
) -> list[list[dict[str, Any]]]:
    """[world][step]: what was seen; a world that is over is restarted with a seed that follows from its own."""
    restarted = len(worlds.acts) == len(seeds)
    actions = np.zeros((len(seeds), len(layout.agents), layout.actions.size), np.float64)
    if restarted:
        batch = worlds.step(_typed(layout, actions), dict(enumerate(seeds)))
    else:
        batch = worlds.reset(seeds)
    generators = [np.random.default_rng(seed) for seed in seeds]
    follow = list(seeds)
    records: list[list[dict[str, Any]]] = [[_record(layout, batch, w)] for w in range(len(seeds))]
    for _ in range(steps):
        if deadline is not None and time.monotonic() > deadline:
            break
        again: dict[int, int] = {}
        for w in range(len(seeds)):
            if batch.active[w].any():
                actions[w] = random_actions(layout, generators[w], None if batch.masks is None else batch.masks[w])
            else:
                follow[w] += 100
                again[w] = follow[w]
        batch = worlds.step(_typed(layout, actions), again)
        for w in range(len(seeds)):
            records[w].append(_record(layout, batch, w))
    return records


def _typed(layout: Layout, actions: np.ndarray) -> np.ndarray:
    return actions.astype(np.int64) if layout.actions.discrete else actions


def _record(layout: Layout, batch: Batch, w: int) -> dict[str, Any]:
    fields = {
        "observations": batch.observations[w],
        "rewards": batch.rewards[w],
        "terminated": batch.terminated[w],
        "truncated": batch.truncated[w],
        "active": batch.active[w],
    }
    if batch.masks is not None:
        fields["masks"] = batch.masks[w]
    if batch.states is not None:
        fields["states"] = batch.states[w]
    return {**{name: value.tobytes() for name, value in fields.items()}, "success": bool(batch.successes[w]), "said": batch.said}


def _compare(layout: Layout, first: list[list[dict[str, Any]]], second: list[list[dict[str, Any]]]) -> Found:
    steps = sum(len(record) - 1 for record in first + second)
    successes = any([step.pop("said") for record in first + second for step in record])
    for index, (a, b) in enumerate(zip(first, second)):
        for t, (x, y) in enumerate(zip(a, b)):
            differing = [name for name in x if x[name] != y[name]]
            if differing:
                text = f"two episodes with seed {SEEDS[index]} and the same actions differ in {differing[0]} at step {t}"
                return Found(False, successes, steps, text)
    return Found(True, successes, steps)
