"""Violations that a check found: one sentence each, and not too many of one rule."""

from __future__ import annotations

from dataclasses import dataclass, field

PER_RULE_MAX = 20

#: Every rule, and what it asks for in words. The order is that of the report.
RULES = {
    "make": "the callable returns environments that can be served, again and again, also after close()",
    "spaces": "observation_space(agent) and action_space(agent) return the same object on each call",
    "agents": "possible_agents is a list of different strings, agents a list of its own with names out of it",
    "reset": "reset(seed=) returns (observations, infos) for exactly the agents in `agents`; reset() alone works afterwards",
    "step": "step(actions) takes every allowed action and returns five dicts",
    "keys": "observations, rewards, terminations, truncations and infos have exactly the agents that acted as keys",
    "observations": "every observation lies in its space",
    "dtypes": "every observation is an array with the dtype of its space",
    "finite": "observations and rewards have neither NaN nor infinities",
    "rewards": "rewards are single numbers",
    "ends": "terminations and truncations are True or False; an agent that ends leaves `agents`, and no agent leaves otherwise",
    "after the end": "`agents` stays empty until the next reset",
    "limits": "an episode ends at its limit of steps, as truncation",
    "masks": "action masks have the shape of the actions and allow one choice at least",
    "state": "state() returns the same number of finite numbers every time",
    "aliasing": "observations do not change after they were returned",
    "actions": "the environment does not change the actions that it is given",
    "same seed": "equal seeds and actions give equal episodes, bit by bit, in every step, in any world and after any episode",
    "other seed": "different seeds give different episodes",
    "pictures": "render() returns an array [height, width, 3] of uint8",
}


@dataclass
class Found:
    rule: str
    sentence: str
    warning: bool


@dataclass
class Report:
    """What was found so far."""

    checked: dict[str, None] = field(default_factory=dict)
    found: list[Found] = field(default_factory=list)
    more: dict[str, int] = field(default_factory=dict)
    deterministic: bool = False
    episodes: int = 0
    steps: int = 0

    def check(self, *rules: str) -> None:
        """Notes that these rules have been looked at."""
        for rule in rules:
            self.checked[RULES[rule]] = None

    def add(self, rule: str, sentence: str, warning: bool = False) -> None:
        self.check(rule)
        if sum(one.rule == rule for one in self.found) >= PER_RULE_MAX:
            self.more[rule] = self.more.get(rule, 0) + 1
            return
        self.found.append(Found(rule, sentence, warning))

    def finish(self) -> list[Found]:
        """All of it, in the order of the rules; the last one of a rule says how many were left out."""
        order = {rule: i for i, rule in enumerate(RULES)}
        left_out = [Found(rule, f"and {count} more of this rule", self._only_warnings(rule)) for rule, count in self.more.items()]
        return sorted(self.found + left_out, key=lambda one: order[one.rule])

    def _only_warnings(self, rule: str) -> bool:
        return all(one.warning for one in self.found if one.rule == rule)
