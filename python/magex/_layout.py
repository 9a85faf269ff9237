"""What an environment is: agents, sizes and flags, found out once and the same for as long as the process lives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from magex._actions import ActionCodec, ActionTable
from magex._observations import ObservationCodec, kind, structure
from magex._problems import Refused, short


@dataclass
class Layout:
    """Sizes in the letters of the protocol: N agents, V numbers of an observation, S numbers of a state."""

    name: str
    agents: list[str]
    observations: list[ObservationCodec]
    actions: ActionTable
    state_width: int = 0
    # Numbers of the first state(), also if it is not sent because it failed later.
    state_seen: int = 0
    steps_max: int = 0
    renders: bool = False
    worlds_max: int = 0
    # [N] whether masks come with the infos of this agent.
    info_masks: list[bool] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.width = max(codec.width for codec in self.observations)
        self.dtype = np.result_type(*(codec.dtype for codec in self.observations))
        first = self.observations[0].shape
        # The shape of every observation, if all are arrays of one shape: then a batch is joined in one call.
        self.shape = first if all(codec.shape == first for codec in self.observations) else None
        self.info_masks = self.info_masks or [False] * len(self.agents)
        own_masks = any(codec.has_mask for codec in self.observations) or any(self.info_masks)
        if own_masks and not self.actions.discrete:
            raise Refused("action_mask: the actions are continuous; leave the mask out, or make the actions Discrete")
        self.own_masks = own_masks
        self.masks = self.actions.discrete and (own_masks or self.actions.needs_mask)


def layout(
    name: str,
    agents: Sequence[str],
    observation_space: Callable[[str], Any],
    action_space: Callable[[str], Any],
    pad: bool,
) -> Layout:
    """Reads the spaces of all agents and refuses by name what cannot be trained with one network."""
    agents = list(agents)
    if not agents:
        raise Refused("possible_agents: is empty; name every agent that can ever act")
    if len(set(agents)) != len(agents):
        raise Refused("possible_agents: a name occurs twice; give every agent a name of its own")
    for agent in agents:
        if not isinstance(agent, str):
            raise Refused(f'possible_agents: {short(agent)} is no string; name agents with strings such as "agent_0"')
    seen = {agent: observation_space(agent) for agent in agents}
    taken = {agent: action_space(agent) for agent in agents}
    observations = [ObservationCodec(seen[agent], agent) for agent in agents]
    actions = [ActionCodec(taken[agent], agent) for agent in agents]
    for agent, action in zip(agents, actions):
        if (action.choices is None) != (actions[0].choices is None):
            raise Refused(
                f'action_space: agent "{agents[0]}" has {short(taken[agents[0]])} and agent "{agent}" {short(taken[agent])}; '
                "discrete and continuous actions cannot be mixed: make all of them the same kind"
            )
    if not pad:
        _same("observation_space", agents, [codec.inner for codec in observations], _seen_as)
        _same("action_space", agents, [taken[agent] for agent in agents], _taken_as)
    return Layout(name, agents, observations, ActionTable(actions, agents))


def _seen_as(space: Any) -> Any:
    return structure(space)


def _taken_as(space: Any) -> Any:
    """Bounds of continuous actions count: the policy's numbers are scaled to them."""
    if kind(space) != "Box":
        return structure(space)
    return structure(space), np.ravel(space.low).tolist(), np.ravel(space.high).tolist()


def _same(field_name: str, agents: list[str], spaces: list[Any], key: Callable[[Any], Any]) -> None:
    first = key(spaces[0])
    for agent, space in zip(agents, spaces):
        if key(space) != first:
            raise Refused(
                f'{field_name}: agent "{agents[0]}" has {short(spaces[0])} and agent "{agent}" {short(space)}; make them equal, '
                "or serve with pad=True (--pad), which fills the smaller one up"
            )


class Batch:
    """What all agents of all W worlds see after a request: the arrays of `Observed`."""

    __slots__ = ("observations", "rewards", "terminated", "truncated", "active", "masks", "states", "successes", "said")

    def __init__(self, layout: Layout, worlds: int) -> None:
        n = len(layout.agents)
        self.observations = np.zeros((worlds, n, layout.width), layout.dtype)
        self.rewards = np.zeros((worlds, n), np.float64)
        self.terminated = np.zeros((worlds, n), np.bool_)
        self.truncated = np.zeros((worlds, n), np.bool_)
        self.active = np.zeros((worlds, n), np.bool_)
        # [W, N, H, largest], from which the wire's [W, N, sum of choices] is taken.
        self.masks = (
            np.broadcast_to(layout.actions.allowed, (worlds, *layout.actions.allowed.shape)).copy() if layout.masks else None
        )
        self.states = np.zeros((worlds, layout.state_width), np.float64) if layout.state_width else None
        self.successes = np.zeros(worlds, np.bool_)
        # Whether anything was said of success where an episode ended.
        self.said = False


def steps_max_of(env: Any) -> int:
    """The environment's own limit of steps, wherever its kind keeps it; 0 if it does not say."""
    inner = getattr(env, "unwrapped", env)
    candidates = [
        getattr(getattr(env, "spec", None), "max_episode_steps", None),
        *(getattr(place, name, None) for place in (env, inner) for name in ("max_cycles", "max_steps", "steps_max")),
    ]
    metadata = getattr(env, "metadata", None)
    if isinstance(metadata, dict):
        candidates += [metadata.get("max_cycles"), metadata.get("max_steps"), metadata.get("max_episode_steps")]
    for value in candidates:
        if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value > 0:
            return int(value)
    return 0


def name_of(env: Any) -> str:
    """A name for people."""
    spec = getattr(env, "spec", None)
    metadata = getattr(env, "metadata", None)
    named = getattr(spec, "id", None) or (metadata.get("name") if isinstance(metadata, dict) else None)
    return str(named) if named else type(getattr(env, "unwrapped", env)).__name__
