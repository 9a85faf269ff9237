"""Checks docs/policy.md's own code, and the exports, against recorded episodes: logits and actions of every executor and task.

    python3 examples/python/check_policy.py MAGEX FOLDER [quick|long] [numpy] [onnx] [tract] [torch]

Trains small runs into FOLDER (those that are there stay), writes traces with `magex trace`, rebuilds every policy from the page's
code (numpy), runs the ONNX files in onnxruntime (onnx) and tract, and the PyTorch modules (torch), and compares. Exits with 1 if anything
differs by more than it may.
"""

import importlib.util
import json
import pathlib
import re
import subprocess
import sys

import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[2]
TASKS = {"spread": "simple-spread", "push": "push-ball", "drones": "drones"}
FLAT = {"kind": "flat"}
# Name: task, agents, [executor], more sections.
SUBJECTS = {
    "spread-magex": ("spread", 5, {"kind": "magex"}, {}),
    "spread-local": ("spread", 5, {"kind": "local"}, {}),
    "spread-literal": ("spread", 5, {"kind": "magex-literal"}, {}),
    "spread-attention": ("spread", 5, {"kind": "attention"}, {}),
    "spread-mlp": ("spread", 5, {"kind": "mlp", "feature_norm": False}, {}),
    "spread-flat": ("spread", 5, {**FLAT, "nearest_first": True}, {}),
    "spread-flat-rnn": ("spread", 5, {**FLAT, "recurrent": True, "observes": "goals"}, {}),
    "spread-mat": ("spread", 5, {"kind": "mat", "attention_heads": 2}, {}),
    "spread-mat-dec": ("spread", 5, {"kind": "mat-dec", "attention_blocks": 2}, {}),
    "spread-dicg": ("spread", 5, {"kind": "dicg", "agent_index": False}, {}),
    "spread-qmix": ("spread", 5, {**FLAT, "recurrent": True}, {"run": {"algorithm": "qmix"}}),
    "push-magex": ("push", 5, {"kind": "magex"}, {}),
    "push-local": ("push", 5, {"kind": "local"}, {}),
    "push-literal": ("push", 5, {"kind": "magex-literal"}, {}),
    "push-flat": ("push", 5, {**FLAT, "nearest_first": True}, {}),
    "drones-magex": ("drones", 4, {"kind": "magex"}, {}),
    "drones-local": ("drones", 4, {"kind": "local"}, {}),
    "drones-mat": ("drones", 4, {"kind": "mat"}, {}),
    "drones-qmix": ("drones", 4, {**FLAT, "recurrent": False}, {"run": {"algorithm": "qmix"}}),
}
FREE = ("magex", "local", "magex-literal", "attention")
SENSITIVE = 1e-5
MOST = 1e-5
# MAGE-X takes the first of the largest log-probabilities, which rounding makes equal for logits this close.
TIE = 5e-7


def magex(program, *arguments):
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"magex {' '.join(map(str, arguments))}: {done.stderr[-800:]}")


def train(program, place, name):
    task, agents, executor, more = SUBJECTS[name]
    if (place / name / "weights.safetensors").exists():
        return
    run = {"max_steps": 2400, "target_success": 2.0, "eval_every": 1000, "eval_episodes": 1, "final_episodes": 1}
    flat = executor["kind"] in ("flat", "mat", "mat-dec", "dicg") and executor.get("observes") != "goals"
    sections = {
        "run": {**run, **more.get("run", {})},
        "task": {"name": TASKS[task], "agents": agents, "spawn": "uniform", "reward_target": "team" if flat else "goals"},
        "executor": executor,
        "commander": {"kind": "random" if flat else "exact"},
        "collect": {"episodes_per_iteration": 8},
    }
    lines = []
    for section, keys in sections.items():
        lines += [f"[{section}]"] + [f"{key} = {json.dumps(value)}" for key, value in keys.items()]
    config = place / f"{name}.toml"
    config.write_text("\n".join(lines) + "\n")
    magex(program, "train", config, "--out", place / name, "--in-process", "--http", "off", "--threads", "1")


def page_policy():
    """The class of the page's own code block."""
    text = (ROOT / "docs/policy.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    code = next(block for block in blocks if "class Policy" in block)
    names = {}
    exec(compile(code, "docs/policy.md", "exec"), names)
    return names["Policy"]


def length(x):
    return np.sqrt((np.asarray(x, np.float64) ** 2).sum(-1))


def sensitive(policy, s, edges):
    """Whether an edge, a rank, a radius or a frame is so near to its threshold that rounding may decide it."""
    p, n = np.asarray(s["positions"], np.float64), len(s["positions"])
    leads = [edges]
    o, kind = policy.o, policy.executor["kind"]
    goal_to = s["goals"] - (s["balls"] if "balls" in s else p)
    leads.append(abs(length(goal_to) - o["success_radius"]).min())
    if policy.kind == "local" or o["encounters"]:
        bodies = np.concatenate([p, s["balls"]]) if "balls" in s else p
        d = length(bodies[None] - p[:, None])
        d[np.arange(n), np.arange(n)] = np.inf
        if "balls" in s:
            d[np.arange(n), n + np.arange(n)] = np.inf
        leads.append(abs(d - o["sensing_radius"]).min())
        k, d = policy.executor["neighbours"], np.sort(d, 1)
        if d.shape[1] > k:
            leads.append(np.where(d[:, k] <= o["sensing_radius"], d[:, k] - d[:, k - 1], np.inf).min())
    if kind in ("flat", "mat", "mat-dec", "dicg") and policy.executor["nearest_first"]:
        for points in [p, s["landmarks"]] + ([s["all_balls"]] if "all_balls" in s else []):
            leads.append(np.diff(np.sort(length(points[None] - p[:, None]), 1), axis=1).min())
    if o["frame"] == "push":
        way, to = np.asarray(goal_to, np.float64), np.asarray(s["balls"], np.float64) - p
        leads.append(abs(abs(way[:, 0]) - abs(way[:, 1])).min())
        leads.append(abs(way).max(1).min())
        leads.append(abs(to[:, 0] * way[:, 1] - to[:, 1] * way[:, 0]).min())
    return min(leads) <= SENSITIVE


class Tally:
    """What was compared."""

    def __init__(self):
        self.rows = self.sensitive = self.states = self.wrong = 0
        self.worst, self.sum = 0.0, 0.0

    def add(self, theirs, actions, trace, t, choices):
        ours = trace["logits"][t]
        self.rows += len(ours)
        difference = abs(theirs - ours).max(1)
        self.worst = max(self.worst, float(difference.max()))
        for k, part in enumerate(np.split(ours, np.cumsum(choices)[:-1], 1)):
            ranked = np.sort(part, 1)
            lead = ranked[:, -1] - ranked[:, -2] > np.maximum(2 * difference, TIE)
            self.wrong += int((lead & (actions[:, k] != trace["actions"][t][:, k])).sum())


def states(trace):
    names = ("positions", "velocities", "goals", "landmarks", "balls", "ball_velocities", "all_balls", "agent_state")
    for t in range(len(trace["positions"])):
        yield t, {name: trace[name][t] for name in names if name in trace}


def compare(act, policy, trace, edges_of):
    """Steps through an episode with the other's own memory; after a state that rounding may decide, it goes on from ours."""
    tally, memory = Tally(), None
    for t, state in states(trace):
        before = trace["memory"][t - 1] if t and "memory" in trace else None
        logits, actions, memory = act(state, memory)
        tally.states += 1
        if sensitive(policy, state, edges_of(state, before)):
            tally.sensitive += 1
            memory = trace["memory"][t] if "memory" in trace else None
            continue
        tally.add(logits, actions, trace, t, policy.choices)
    return tally


def numpy_act(policy):
    return lambda state, memory: policy.act(state, memory)


def onnx_act(path, policy):
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]
    outputs = [value.name for value in session.get_outputs()]
    return graph_act(names, policy, lambda feed: dict(zip(outputs, session.run(None, feed))))


def tract_act(path, policy):
    import tract

    loaded = {}

    def run(feed):
        shape = next(iter(feed.values())).shape
        if shape not in loaded:
            model = tract.onnx().load(str(path))
            names = [model.input_name(k) for k in range(model.input_count())]
            for k, name in enumerate(names):
                model.set_input_fact(k, ",".join(map(str, feed[name].shape)) + ",f32")
            outputs = ["logits", "actions", "memory_out"][: model.output_count()]
            loaded[shape] = names, outputs, model.into_model().into_runnable()
        names, outputs, runnable = loaded[shape]
        found = runnable.run([np.ascontiguousarray(feed[name]) for name in names])
        return {name: value.to_numpy() for name, value in zip(outputs, found)}

    model = tract.onnx().load(str(path))
    return graph_act([model.input_name(k) for k in range(model.input_count())], policy, run)


def graph_act(names, policy, run):
    """Acts by a graph whose inputs have these names."""

    def act(state, memory):
        feed = {name: values[None] for name, values in state.items() if name in names}
        if "landmarks" in names and "all_balls" in state:
            feed["balls"] = state["all_balls"][None]
        if "half_side" in names:
            feed["half_side"] = np.array([policy.half_side], "f4")
        if "memory" in names:
            width = policy.about["memory"]
            feed["memory"] = np.zeros((1, len(state["positions"]), width), "f4") if memory is None else memory[None]
        out = run(feed)
        return out["logits"][0], out["actions"][0], out["memory_out"][0] if "memory_out" in out else None

    return act


def torch_act(path, policy):
    import torch

    spec = importlib.util.spec_from_file_location(f"policy_{path.parent.name.replace('-', '_')}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    other = module.Policy.load(half_side=float(policy.half_side))
    landmarks = policy.executor["observes"] == "landmarks" and policy.executor["kind"] in ("flat", "mat", "mat-dec", "dicg")

    def act(state, memory):
        s = {name: torch.from_numpy(np.ascontiguousarray(values))[None] for name, values in state.items()}
        goals, balls = (s["landmarks"], s.get("all_balls")) if landmarks else (s["goals"], s.get("balls"))
        memory = None if memory is None else torch.from_numpy(np.ascontiguousarray(memory))[None]
        out = other(s["positions"], s["velocities"], goals, memory, balls, s.get("ball_velocities"), s.get("agent_state"))
        return out[0][0].numpy(), out[1][0].numpy(), out[2][0].numpy() if policy.about["memory"] else None

    return act


def hashes(run, kinds):
    """policy_sha256 of the weights file, and of the tensors as they stand in the exports."""
    import hashlib

    summary = json.loads((run / "summary.json").read_text())["weights_sha256"]
    policy = page_policy()(run / "weights.safetensors")
    ours = hashlib.sha256(b"".join(policy.w[name].tobytes() for name in sorted(policy.w) if not name.startswith("value."))).hexdigest()
    if "onnx" in kinds:
        import onnxruntime

        meta = onnxruntime.InferenceSession(str(run / "policy.onnx")).get_modelmeta().custom_metadata_map
        assert (meta["weights_sha256"], meta["policy_sha256"]) == (summary, ours), run
        assert meta["task"] and meta["run"] and meta["length_unit"] and meta["magex_version"], meta
        try:
            import onnx
        except ImportError:
            return
        graph = onnx.load(str(run / "policy.onnx")).graph
        tensors = {i.name.split(".", 1)[1]: i.raw_data for i in graph.initializer if "." in i.name and not i.name.startswith("i")}
        theirs = hashlib.sha256(b"".join(tensors[name] for name in sorted(tensors))).hexdigest()
        assert theirs == ours, f"{run}: {sorted(set(policy.w) ^ set(tensors))}"
    if "torch" in kinds:
        assert hashlib.sha256((run / "policy.safetensors").read_bytes()).hexdigest() == summary, run


def main():
    program, place, *rest = sys.argv[1:]
    place = pathlib.Path(place)
    place.mkdir(parents=True, exist_ok=True)
    long = "long" in rest
    kinds = [kind for kind in ("numpy", "onnx", "tract", "torch") if kind in rest] or ["numpy"]
    Policy, failed = page_policy(), False
    per_task = {}
    for name, (task, agents, executor, _) in SUBJECTS.items():
        run = place / name
        train(program, place, name)
        if {"onnx", "tract"} & set(kinds):
            magex(program, "export", run, "--format", "onnx")
        if "torch" in kinds:
            magex(program, "export", run, "--format", "torch")
        hashes(run, kinds)
        sizes = {agents: 0}
        if long and executor["kind"] in FREE and task != "drones":
            sizes = {5: 0, 50: 0, 200: 0}
        for size in sizes:
            horizon = max(20, 10_000 // size) if long else 60
            file = place / f"{name}-{size}-{horizon}.npz"
            if not file.exists():
                more = ["--agents", size] if size != agents else []
                magex(program, "trace", run, "--out", file, "--horizon", horizon, *more)
            trace = dict(np.load(file))
            about = json.loads(bytes(trace["about"]))
            policy = Policy(run / "weights.safetensors", side=about["task"]["side"])

            def edges(state, memory, policy=policy):
                policy.margin = np.inf
                policy.act(state, memory)
                return policy.margin

            for kind in kinds:
                make = {"numpy": lambda: numpy_act(Policy(run / "weights.safetensors", side=about["task"]["side"]))}
                make["onnx"] = lambda: onnx_act(run / "policy.onnx", policy)
                make["tract"] = lambda: tract_act(run / "policy.onnx", policy)
                make["torch"] = lambda: torch_act(run / "policy.py", policy)
                tally = compare(make[kind](), policy, trace, edges)
                bad = tally.wrong > 0 or tally.worst > MOST or tally.rows == 0 and tally.states == 0
                failed |= bad
                per_task[task, kind] = per_task.get((task, kind), 0) + tally.rows
                print(
                    f"{kind:6} {name:18} N = {size:3}: {tally.rows:6} agent-steps, largest difference {tally.worst:.1e}, "
                    f"{tally.wrong} actions differ, {tally.sensitive} of {tally.states} states left out{'  BAD' if bad else ''}",
                    flush=True,
                )
    for (task, kind), rows in per_task.items():
        print(f"{kind}: {task}: {rows} agent-steps compared")
    return failed


if __name__ == "__main__":
    raise SystemExit(main())
