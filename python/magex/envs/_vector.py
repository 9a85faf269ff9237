"""Many worlds of a task at once, in NumPy arrays that the simulator writes itself."""

from __future__ import annotations

import secrets
from typing import Any

import numpy as np

from magex._native import native
from magex.envs._picture import picture

#: The tasks, and the agents of a team whose size is left out.
AGENTS = {"simple_spread": 50, "push_ball": 20, "drones": 4}


class VectorEnv:
    """W worlds of one task with N agents each. Make one with `magex.envs.vector`.

    Arrays have the worlds as their first axis and the agents as their second one:
    observations float32 [W, N, V], rewards float32 [W, N], terminations and truncations bool [W, N],
    actions integers [W, N], or [W, N, 3] for drones.

    Every episode lasts `horizon` steps and ends for all agents of all worlds in the same step, by truncation; nothing
    terminates. Autoreset is SAME_STEP: that step returns the first observations of the next episodes, and `infos` has
    `final_obs` [W, N, V] and `final_info`, a dict of float32 [W] with what the episodes scored. With autoreset="disabled"
    it returns the last observations, and `reset` has to follow.
    """

    def __init__(self, core: Any, task: str, *, autoreset: str, copy: bool) -> None:
        if autoreset not in ("same_step", "disabled"):
            raise ValueError(f"autoreset: '{autoreset}' is not a mode; use same_step or disabled")
        self._core = core
        self.task = task
        #: W, N, D (dimensions), E (bodies), K (goals per agent), H (components of an action), V, X (see `state`).
        self.worlds, self.agents, self.dims, self.bodies, self._goals, self._components, self.width, _ = core.sizes
        self.num_envs = self.worlds
        self.horizon: int = core.horizon
        self.side: float = core.side
        self.metadata = {
            "name": f"{task}_v0",
            "autoreset_mode": _mode(autoreset),
            "render_modes": ["rgb_array"],
            "render_fps": round(1.0 / core.step_seconds),
        }
        self.render_mode = "rgb_array"
        self._restarts = autoreset == "same_step"
        self._copy = copy
        self._seeded = False
        shape = (self.worlds, self.agents)
        self._observations = np.zeros((*shape, self.width), np.float32)
        self._rewards = np.zeros(shape, np.float32)
        # They have these two values only, so they are made once; nothing may write to them.
        self._no, self._yes = np.zeros(shape, np.bool_), np.ones(shape, np.bool_)
        self._no.flags.writeable = self._yes.flags.writeable = False
        self._spaces: dict[str, Any] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode in every world; returns observations [W, N, V] and infos.

        seed: world w gets the seed + w, and its episodes are a function of that number, of the goals and of the actions only.
        Without a seed, the next episodes of the last seed begin; without a reset before, those of a random one.
        options: "goals", integers [W, N] (push_ball [W, N, 2]); without them goals are assigned (`set_goals`).
        "positions" float32 [W, E, D] and "landmarks" float32 [W, N, D], and "velocities" like positions (0 if left out), begin
        this episode in that state.
        """
        options = options or {}
        unknown = set(options) - {"goals", "positions", "velocities", "landmarks"}
        if unknown:
            raise ValueError(f"options: {min(unknown)} is unknown; use goals, positions, velocities and landmarks")
        if seed is not None and not (isinstance(seed, (int, np.integer)) and 0 <= seed < 2**64):
            raise ValueError(f"seed: {seed!r} is not a seed; use a whole number from 0 to below 2^64")
        if seed is None and not self._seeded:
            seed = secrets.randbits(62)
        self._core.reset(None if seed is None else int(seed), self._start(options))
        self._seeded = True
        if options.get("goals") is not None:
            return self.set_goals(options["goals"]), {}
        return self.observe(), {}

    def _start(self, options: dict[str, Any]) -> list[np.ndarray] | None:
        """The state that an episode is asked to begin with: positions, velocities, landmarks."""
        positions, velocities, landmarks = (options.get(key) for key in ("positions", "velocities", "landmarks"))
        if positions is None and velocities is None and landmarks is None:
            return None
        for field, value in (("positions", positions), ("landmarks", landmarks)):
            if value is None:
                raise ValueError(f"options: {field} is missing; a state has positions and landmarks")
        if velocities is None:
            velocities = np.zeros_like(positions)
        arrays = []
        for field, value in (("positions", positions), ("velocities", velocities), ("landmarks", landmarks)):
            try:
                arrays.append(np.ascontiguousarray(value, dtype=np.float32))
            except (TypeError, ValueError):
                raise ValueError(f"{field}: is not an array of numbers; pass floats") from None
        return arrays

    def set_goals(self, goals: Any) -> np.ndarray:
        """Gives every agent goals of the caller's choice, until the episode ends; returns the observations, which they change.

        goals: [W, N] (or [N] for all worlds alike) the index of the agent's landmark; in push_ball [W, N, 2] (or [N, 2]): the
        agent's ball, and that ball's landmark. Two agents may have the same.
        Without this call goals are assigned by the smallest total distance (in push_ball agents to balls, balls to landmarks).
        """
        array = np.asarray(goals)
        if array.dtype.kind not in "iu":
            raise ValueError(f"goals: is of type {array.dtype}; pass whole numbers")
        if self._goals == 1 and array.ndim in (1, 2) and array.shape[-1] == self.agents:
            array = array[..., None]
        wanted = (self.worlds, self.agents, self._goals)
        if array.shape not in (wanted, wanted[1:]):
            kind = "[worlds, agents]" if self._goals == 1 else "[worlds, agents, 2]"
            raise ValueError(f"goals: has the shape {array.shape}; pass {kind}, here {wanted}")
        if array.size and array.min() < 0:
            raise ValueError(f"goals: {array.min()} is not a goal; use an index from 0 to below {self.agents}")
        array = np.minimum(array, np.uint32(2**32 - 1)) if array.dtype.itemsize > 4 else array
        self._core.set_goals(np.ascontiguousarray(np.broadcast_to(array, wanted), dtype=np.uint32))
        return self.observe()

    def step(
        self, actions: Any, out: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every world: observations, rewards, terminations, truncations, infos.

        actions: integers [W, N] (0 none, 1 +x, 2 -x, 3 +y, 4 -y), for drones [W, N, 3] (per axis 0 forward, 1 stop, 2 backward).
        uint8 is taken as it is, other types are converted.
        out: float32 [W, N, V] that is filled with the observations and returned, for example a row of a rollout's buffer.
        """
        array = np.ascontiguousarray(actions)
        if array.dtype not in (np.uint8, np.int32, np.int64):
            if array.dtype.kind not in "iu":
                raise ValueError(f"actions: are of type {array.dtype}; pass whole numbers")
            array = array.astype(np.int64)
        if self._components == 1 and array.shape == (self.worlds, self.agents):
            array = array.reshape(self.worlds, self.agents, 1)
        if out is None:
            out = np.empty_like(self._observations) if self._copy else self._observations
        rewards = np.empty_like(self._rewards) if self._copy else self._rewards
        last = self._last()
        ended, metrics = self._core.step(array, rewards, out, last, self._restarts)
        if not ended:
            return out, rewards, self._no, self._no, {}
        infos: dict[str, Any] = {"final_info": metrics, "_final_info": np.ones(self.worlds, np.bool_)}
        if last is not None:
            infos |= {"final_obs": last, "_final_obs": np.ones(self.worlds, np.bool_)}
        return out, rewards, self._no, self._yes, infos

    def _last(self) -> np.ndarray | None:
        """Room for the last observations of episodes that end with the next step."""
        ends = self._restarts and self._core.steps + 1 == self.horizon
        return np.empty_like(self._observations) if ends else None

    def observe(self) -> np.ndarray:
        """The present observations [W, N, V]."""
        out = np.empty_like(self._observations) if self._copy else self._observations
        self._core.observe(out)
        return out

    def state(self) -> dict[str, np.ndarray]:
        """Where everything is, as new arrays, in world units, world units per second, indices.

        positions and velocities float32 [W, E, D]: agents, then (push_ball) balls. landmarks float32 [W, N, D].
        goals uint32 [W, N, K]. agent_state float32 [W, N, X]: drones have target velocity (3), x and y of the body's up axis,
        and 1 if the drone is out; X = 0 in the other tasks.
        """
        (positions, velocities, agent_state, landmarks), goals = self._core.state()
        return {
            "positions": positions,
            "velocities": velocities,
            "agent_state": agent_state,
            "landmarks": landmarks,
            "goals": goals,
        }

    def render(self, world: int = 0, size: int = 512) -> np.ndarray:
        """A picture [size, size, 3] uint8 of a world from above: agents blue, balls grey, landmarks orange, crashed drones red."""
        state = self.state()
        extra = state["agent_state"][world]
        out = extra[:, -1] > 0 if extra.shape[1] else np.zeros(self.agents, np.bool_)
        mark = self._core.landmark_radius
        return picture(state["positions"][world], state["landmarks"][world], self.agents, out, self.side, mark, size)

    def close(self) -> None:
        """Nothing is held that needs to be given back."""

    @property
    def agent_observation_space(self) -> Any:
        """Gymnasium's space of the observation of one agent."""
        return self._space("agent_observation", lambda s: s.Box(-np.inf, np.inf, (self.width,), np.float32))

    @property
    def agent_action_space(self) -> Any:
        """Gymnasium's space of the action of one agent: Discrete(5), for drones MultiDiscrete([3, 3, 3])."""
        choices, heads = self._core.choices, self._components
        if heads == 1:
            return self._space("agent_action", lambda s: s.Discrete(choices))
        return self._space("agent_action", lambda s: s.MultiDiscrete([choices] * heads))

    @property
    def observation_space(self) -> Any:
        """Gymnasium's space of all observations."""
        shape = self._observations.shape
        return self._space("observation", lambda s: s.Box(-np.inf, np.inf, shape, np.float32))

    @property
    def action_space(self) -> Any:
        """Gymnasium's space of all actions."""
        shape = (self.worlds, self.agents, self._components)[: 2 if self._components == 1 else 3]
        return self._space("action", lambda s: s.MultiDiscrete(np.full(shape, self._core.choices)))

    def _space(self, key: str, make: Any) -> Any:
        # Libraries compare spaces by identity.
        if key not in self._spaces:
            self._spaces[key] = make(_gymnasium().spaces)
        return self._spaces[key]


def _gymnasium() -> Any:
    try:
        import gymnasium
    except ModuleNotFoundError as error:
        if error.name != "gymnasium":
            raise
        raise ImportError("spaces need the package gymnasium, which is not installed: pip install gymnasium") from None
    return gymnasium


def _mode(autoreset: str) -> Any:
    """Gymnasium's name of the mode if Gymnasium is there, else its value."""
    name = {"same_step": "SAME_STEP", "disabled": "DISABLED"}[autoreset]
    try:
        from gymnasium.vector import AutoresetMode
    except ImportError:
        return {"SAME_STEP": "SameStep", "DISABLED": "Disabled"}[name]
    return AutoresetMode[name]


def vector(
    task: str,
    *,
    agents: int | None = None,
    worlds: int = 1,
    spawn: str = "uniform",
    side: float | None = None,
    horizon: int | None = None,
    reward: str = "goals",
    observation: str = "vector",
    neighbours: int = 6,
    settings: dict[str, float | str] | None = None,
    autoreset: str = "same_step",
    copy: bool = True,
    threads: int | None = None,
) -> VectorEnv:
    """W = `worlds` worlds of a task with N = `agents` agents each.

    task: "simple_spread", "push_ball" or "drones".
    agents: 1 to 5000; 50 if it is left out, in push_ball 20, of drones 4.
    spawn: "uniform", "lines" or "authors" (of the paper's four layouts one per episode; "lines-2" fixes one). Drones: uniform.
    side: of the square map, world units (drones: metres); the paper's for the team size if it is left out.
    horizon: steps of an episode; the paper's for the team size and the side if it is left out.
    reward: "goals" pays each agent for its own goals, "team" all agents for the coverage of all landmarks.
    observation: "vector" is the classical one (own goals with reward "goals", all landmarks and balls with "team"), "goal" has own
    goals and the nearest `neighbours` bodies, "none" has no numbers.
    settings: coefficients of the reward and of the physics, the keys of [task.reward], [task.push_ball] or [task.drones].
    autoreset: "same_step" or "disabled".
    copy: True returns new arrays in every step; False the same ones, overwritten.
    threads: as many as there are cores if it is left out; no number depends on it.
    """
    module = native("magex.envs")
    name = task.replace("-", "_") if isinstance(task, str) else task
    if name not in AGENTS:
        raise ValueError(f"task: {task!r} is not a task; use simple_spread, push_ball or drones")
    for field, value in (("agents", agents), ("worlds", worlds), ("threads", threads), ("neighbours", neighbours)):
        if value is not None and not (isinstance(value, (int, np.integer)) and 0 <= value < 2**32):
            raise ValueError(f"{field}: {value!r} is out of range; use a whole number from 1")
    if horizon is not None and not (isinstance(horizon, (int, np.integer)) and 0 <= horizon < 2**32):
        raise ValueError(f"horizon: {horizon!r} is out of range; use a whole number from 1")
    if agents is None:
        agents = AGENTS[name]
    core = module.Worlds(
        name,
        agents,
        worlds,
        spawn=str(spawn),
        side=None if side is None else float(side),
        horizon=horizon,
        reward=str(reward),
        observation=str(observation),
        neighbours=neighbours,
        settings=settings,
        threads=threads or 0,
    )
    return VectorEnv(core, name, autoreset=autoreset, copy=copy)
