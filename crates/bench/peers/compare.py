"""Our training and stepping beside other people's, in turn on this machine: medians, ratios, and what is not equal."""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
CONFIGS = ROOT / "deploy" / "configs"

NOT_EQUAL = {
    "ippo": "theirs: landmarks at random and episodes of 26 steps, no normalisation of values, one program compiled for "
    "these shapes (compilation not timed). Ours: ValueNorm, whole episodes of 25 steps, a run folder with metrics. "
    "Their observation also has two zeros per other agent (their communication channel).",
    "local": "ours is another network of about the same size (k nearest neighbours pooled), and the goal commander decides "
    "and learns in its time; theirs is the IPPO of the row above, which has no commander.",
    "mappo-gru": "as for ippo. Theirs goes back through the whole rollout of 125 steps with memories cleared where episodes "
    "began, ours through chunks of a whole episode: the same gradients. Their critic reads [vector; state] row by row, "
    "ours multiplies the state once per joint state: the same function.",
    "mappo-torch": "theirs steps mpe2's Python worlds in two processes and is interpreted, as its authors' code is; ours has "
    "its own environment. The same GRU of 64 units, chunks of 10, episodes of 30, 10 epochs, one minibatch.",
    "env": "jaxmarl and vmas hand out observations, ours hands out states (features are made in the network's pass). "
    "jaxmarl and vmas use two threads, ours is per core.",
}


def ours_train(magex, config, agents, settings, max_steps):
    """Joint environment steps per second between the end of the first iteration and the end of the last."""
    folder = tempfile.mkdtemp(prefix="peers-")
    every = ["run.eval_every=1000000", "run.checkpoint_every=1000000", f"run.max_steps={max_steps}"]
    settings = [f"task.agents={agents}", *settings, *every]
    command = [magex, "train", str(config), "--in-process", "--threads", "2", "--http", "off", "--out", f"{folder}/run"]
    command += [part for setting in settings for part in ("--set", setting)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment())
        # 69: the budget ended before the target; there is no target here that could be reached.
        if not Path(f"{folder}/run/metrics.jsonl").exists():
            sys.exit(f"{' '.join(command)}\n{done.stderr}")
        lines = [json.loads(line) for line in open(f"{folder}/run/metrics.jsonl", encoding="utf-8")]
        trained = [line for line in lines if line["executor"]]
        first, last = trained[0], trained[-1]
        steps = last["joint_env_steps"] - first["joint_env_steps"]
        return steps / (last["wall_s"] - first["wall_s"])
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def ours_env(bench, agents):
    done = subprocess.run([bench, "env", "--seconds", "1", "--json"], capture_output=True, text=True, check=True, env=environment())
    rows = json.loads(done.stdout.splitlines()[-1])
    return env_row(rows, agents)


def env_row(report, agents):
    for row in report["env"]["rows"]:
        if row.get("task") == "simple-spread" and row.get("agents") == agents:
            return row["joint_steps_per_s"]
    sys.exit(f"magex-bench env has no row of simple-spread with {agents} agents")


def environment():
    return {**os.environ, "RAYON_NUM_THREADS": "1", "CANDLE_NUM_THREADS": "1"}


def theirs(script, key, *options):
    command = [sys.executable, str(HERE / script), *map(str, options)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])[key]


def contests(args):
    """(name, agents, {side: measurement})."""
    flat = ["executor.nearest_first=false", "executor.agent_index=false", "task.horizon=25"]
    speed = "joint_env_steps_per_s"
    for agents in args.agents:
        iterations = {5: 40, 20: 12}.get(agents, 5)
        shape = ["collect.episodes_per_iteration=80", "mappo.epochs=4", f"mappo.minibatch_size={500 * agents}"]
        budget = 2000 * (iterations + 1)
        jax = ("--agents", agents, "--iterations", iterations)
        yield "ippo", agents, {
            "JAX": lambda jax=jax: theirs("jax_ppo.py", speed, "--policy", "ippo", *jax),
            "ours": lambda a=agents, s=shape, b=budget: ours_train(args.magex, CONFIGS / "baselines/ippo.toml", a, flat + s, b),
        }
        yield "local", agents, {
            "JAX": lambda jax=jax: theirs("jax_ppo.py", speed, "--policy", "ippo", *jax),
            "ours": lambda a=agents, s=shape, b=budget: ours_train(
                args.magex, CONFIGS / "spread-5.toml", a, ["executor.kind=local", "task.horizon=25", *s], b
            ),
        }
        shape = ["executor.hidden=128", "mappo.chunk_length=25", *shape]
        slow = max(iterations // 4, 2)
        yield "mappo-gru", agents, {
            "JAX": lambda a=agents, i=slow: theirs(
                "jax_ppo.py", speed, "--policy", "mappo-gru", "--agents", a, "--hidden", 128, "--iterations", i
            ),
            "ours": lambda a=agents, s=shape, b=2000 * (slow + 1): ours_train(
                args.magex, CONFIGS / "baselines/mappo-rnn.toml", a, flat + s, b
            ),
        }
        shape = ["task.horizon=30", "collect.episodes_per_iteration=32", "mappo.chunk_length=10", "mappo.epochs=10"]
        shape += [f"mappo.minibatch_size={960 * agents}"]
        yield "mappo-torch", agents, {
            "PyTorch": lambda a=agents: theirs("torch_mappo.py", speed, "--agents", a, "--iterations", 3 if a < 20 else 1),
            "ours": lambda a=agents, s=shape, b=960 * (iterations + 1): ours_train(
                args.magex, CONFIGS / "baselines/mappo-rnn.toml", a, flat[:2] + s, b
            ),
        }
        yield "env", agents, {
            "jaxmarl": lambda a=agents: theirs("env_steps.py", "env_steps_per_s", "jaxmarl", "--agents", a),
            "vmas": lambda a=agents: theirs("env_steps.py", "env_steps_per_s", "vmas", "--agents", a, "--steps", 20),
            "ours": lambda a=agents: ours_env(args.bench, a),
        }


def main():
    parser = argparse.ArgumentParser(prog="crates/bench/peers/run", description=__doc__)
    parser.add_argument("--pairs", type=int, default=5, help="measurements of each side, in turn (default 5)")
    parser.add_argument("--agents", default="5,20,50", help="team sizes (default 5,20,50)")
    parser.add_argument("--only", default=",".join(NOT_EQUAL), help=f"of {','.join(NOT_EQUAL)}")
    parser.add_argument("--magex", default=str(ROOT / "target/release/magex"))
    parser.add_argument("--bench", default=str(ROOT / "target/release/magex-bench"))
    parser.add_argument("--json", help="file for the single measurements")
    args = parser.parse_args()
    args.agents, only = [int(a) for a in args.agents.split(",")], args.only.split(",")
    if unknown := set(only) - set(NOT_EQUAL):
        parser.error(f"--only: {', '.join(sorted(unknown))} is none of {', '.join(NOT_EQUAL)}")
    for option in ("magex", "bench"):
        if not Path(getattr(args, option)).exists():
            parser.error(f"--{option}: there is no {getattr(args, option)}; cargo build --release -p magex -p magex-bench")

    records = []
    print(f"{'what':<12} {'N':>3}  {'peer':<8} {'peer/s':>10} {'ours/s':>10} {'ratio':>7}  ratios of the pairs")
    for name, agents, sides in contests(args):
        if name not in only:
            continue
        seen = {side: [] for side in sides}
        for _ in range(args.pairs):
            for side, measure in sides.items():
                seen[side].append(measure())
        for side in sides:
            if side == "ours":
                continue
            ratios = [ours / peer for ours, peer in zip(seen["ours"], seen[side])]
            medians = [statistics.median(x) for x in (seen[side], seen["ours"])]
            pairs = " ".join(f"{ratio:.2f}" for ratio in ratios)
            print(f"{name:<12} {agents:>3}  {side:<8} {medians[0]:>10,.0f} {medians[1]:>10,.0f} {statistics.median(ratios):>7.2f}  {pairs}", flush=True)
        records.append({"what": name, "agents": agents, "steps_per_s": seen})
    if args.json:
        Path(args.json).write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
    print("\nNot equal:")
    for name in only:
        print(f"- {name}: {NOT_EQUAL[name]}")


if __name__ == "__main__":
    main()
