"""Recurrent MAPPO in PyTorch with the shapes of its authors' code: mpe2 worlds in processes, a GRU in chunks, many epochs.

Arrays: T steps, B worlds, N agents, A = B·N rows, L steps of a chunk. See README.md for what is not equal.
"""

import argparse
import json
import multiprocessing
import time

import numpy as np
import torch
from mpe2 import simple_spread_v3
from torch import nn


def world_process(pipe, count, agents, horizon, seed):
    """Steps `count` worlds; answers (observations [count, N, D], states [count, S], rewards [count, N])."""
    worlds = [
        simple_spread_v3.parallel_env(N=agents, max_cycles=horizon, dynamic_rescaling=False) for _ in range(count)
    ]
    for index, world in enumerate(worlds):
        world.reset(seed=seed + index)
    names = list(worlds[0].agents)
    last = [world.reset()[0] for world in worlds]
    rewards = np.zeros((count, agents), np.float32)

    def state(world):
        bodies = world.unwrapped.world
        parts = [b.state.p_pos for b in bodies.agents + bodies.landmarks] + [b.state.p_vel for b in bodies.agents]
        return np.concatenate(parts)

    while True:
        observations = np.stack([[seen[name] for name in names] for seen in last]).astype(np.float32)
        pipe.send((observations, np.stack([state(w) for w in worlds]).astype(np.float32), rewards))
        actions = pipe.recv()
        if actions is None:
            return
        rewards = np.zeros((count, agents), np.float32)
        for index, world in enumerate(worlds):
            chosen = {name: int(a) for name, a in zip(names, actions[index])}
            seen, reward, _, truncated, _ = world.step(chosen)
            rewards[index] = [reward[name] for name in names]
            last[index] = world.reset()[0] if all(truncated.values()) else seen


class Net(nn.Module):
    """vector → h (tanh) → GRU → outputs, for inputs [L, A, D]."""

    def __init__(self, width, hidden, outputs, gain):
        super().__init__()
        self.first, self.memory, self.head = nn.Linear(width, hidden), nn.GRU(hidden, hidden), nn.Linear(hidden, outputs)
        for layer, g in [(self.first, 2**0.5), (self.head, gain)]:
            nn.init.orthogonal_(layer.weight, g)
            nn.init.zeros_(layer.bias)

    def forward(self, vectors, memory):
        features, memory = self.memory(torch.tanh(self.first(vectors)), memory[None])
        return self.head(features), memory[0]


class Training:
    def __init__(self, args):
        self.args = args
        context = multiprocessing.get_context("fork")
        self.pipes, self.processes = [], []
        for index in range(args.processes):
            ours, theirs = context.Pipe()
            share = args.worlds // args.processes
            seed = args.seed * 10_000 + index * share
            process = context.Process(target=world_process, args=(theirs, share, args.agents, args.horizon, seed), daemon=True)
            process.start()
            self.pipes.append(ours)
            self.processes.append(process)
        self.inputs = self.receive()
        width, seen = self.inputs[0].shape[-1], self.inputs[1].shape[-1]
        self.policy, self.value = Net(width, args.hidden, 5, 0.01), Net(seen, args.hidden, 1, 1.0)
        self.optimisers = [torch.optim.Adam(net.parameters(), lr=args.rate, eps=1e-5) for net in (self.policy, self.value)]

    def receive(self):
        """(vectors [A, D], critic's inputs [A, D + S], rewards [A])."""
        parts = [np.concatenate(part) for part in zip(*[pipe.recv() for pipe in self.pipes])]
        vectors, state, rewards = (torch.from_numpy(part) for part in parts)
        critic = torch.cat([vectors, state[:, None].expand(-1, self.args.agents, -1)], dim=-1)
        return vectors.flatten(0, 1), critic.flatten(0, 1), rewards.flatten()

    def close(self):
        for pipe in self.pipes:
            pipe.send(None)
        for process in self.processes:
            process.join()

    @torch.no_grad()
    def rollout(self):
        args, rows = self.args, self.args.worlds * self.args.agents
        vectors, critic, _ = self.inputs
        memory_p = memory_v = torch.zeros(rows, args.hidden)
        steps, chunks = [], []
        for t in range(args.horizon):
            if t % args.chunk == 0:
                chunks.append((memory_p, memory_v))
            logits, memory_p = self.policy(vectors[None], memory_p)
            values, memory_v = self.value(critic[None], memory_v)
            choice = torch.distributions.Categorical(logits=logits[0])
            actions = choice.sample()
            for pipe, part in zip(self.pipes, actions.numpy().reshape(args.processes, -1, args.agents)):
                pipe.send(part)
            step = (vectors, critic, actions, choice.log_prob(actions), values[0, :, 0])
            self.inputs = vectors, critic, rewards = self.receive()
            steps.append(step + (rewards,))
        columns = [torch.stack(column) for column in zip(*steps)]
        return columns, [torch.stack(m) for m in zip(*chunks)]

    def update(self, columns, memories):
        args = self.args
        vectors, critic, actions, old_log_probs, values, rewards = columns
        # The episode ends where the rollout does, and its last state is worth nothing, as in the authors' code.
        advantages = torch.zeros_like(values)
        advantage = next_value = torch.zeros_like(values[0])
        for t in reversed(range(args.horizon)):
            advantage = rewards[t] + args.gamma * next_value - values[t] + args.gamma * args.gae_lambda * advantage
            advantages[t], next_value = advantage, values[t]
        returns = advantages + values
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-5)

        def in_chunks(x):
            """[T, A, ...] → [L, T/L·A, ...]."""
            x = x.reshape((args.horizon // args.chunk, args.chunk) + x.shape[1:])
            return x.transpose(0, 1).flatten(1, 2)

        data = [in_chunks(x) for x in (vectors, critic, actions, old_log_probs, values, advantages, returns)]
        memories = [memory.flatten(0, 1) for memory in memories]
        count = data[0].shape[1]
        for _ in range(args.epochs):
            for part in torch.randperm(count).chunk(args.minibatches):
                vectors, critic, actions, old, old_values, advantages, returns = (x[:, part] for x in data)
                logits, _ = self.policy(vectors, memories[0][part])
                choice = torch.distributions.Categorical(logits=logits)
                ratio = torch.exp(choice.log_prob(actions) - old)
                clipped = ratio.clamp(1 - args.clip, 1 + args.clip)
                loss = -torch.min(ratio * advantages, clipped * advantages).mean() - args.entropy * choice.entropy().mean()
                now = self.value(critic, memories[1][part])[0][..., 0]
                near = old_values + (now - old_values).clamp(-args.clip, args.clip)
                huber = nn.functional.huber_loss
                errors = [huber(x, returns, reduction="none", delta=10.0) for x in (now, near)]
                for net, objective, optimiser in zip(
                    (self.policy, self.value), (loss, torch.max(*errors).mean()), self.optimisers
                ):
                    optimiser.zero_grad()
                    objective.backward()
                    nn.utils.clip_grad_norm_(net.parameters(), 10.0)
                    optimiser.step()
        return float(rewards.mean())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in [("agents", 5), ("worlds", 32), ("horizon", 30), ("chunk", 10), ("epochs", 10), ("minibatches", 1)]:
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--hidden", type=int, default=64)
    parser.add_argument("--processes", type=int, default=2, help="processes that step the worlds")
    parser.add_argument("--iterations", type=int, default=3, help="updates that are timed, after one that is not")
    parser.add_argument("--seed", type=int, default=1)
    for name, default in [("rate", 7e-4), ("gamma", 0.99), ("gae-lambda", 0.95), ("clip", 0.2), ("entropy", 0.01)]:
        parser.add_argument(f"--{name}", type=float, default=default)
    args = parser.parse_args()
    if args.worlds % args.processes or args.horizon % args.chunk:
        parser.error("--processes must divide --worlds, and --chunk --horizon")
    torch.manual_seed(args.seed)

    training = Training(args)
    rewards = []
    for iteration in range(args.iterations + 1):
        if iteration == 1:
            began = time.perf_counter()
        rewards.append(training.update(*training.rollout()))
    seconds = time.perf_counter() - began
    training.close()
    steps = args.iterations * args.horizon * args.worlds
    print(json.dumps({
        "joint_env_steps_per_s": steps / seconds, "seconds": seconds, "joint_env_steps": steps,
        "reward_first": rewards[0], "reward_last": rewards[-1],
    }))


if __name__ == "__main__":
    main()
