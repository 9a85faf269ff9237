"""IPPO (MLP) and recurrent MAPPO (GRU) in JAX on jaxmarl's Simple Spread: rollout and update in one compiled program.

Arrays: T steps, B worlds, N agents, A = B·N rows (agent-major within a world), D features, S state of the team.
The networks are those of the product's executor `flat`, two separate ones; see README.md for what is not equal.
"""

import argparse
import json
import time
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxmarl.environments.mpe.simple_spread import SimpleSpreadMPE


class Memory(nn.Module):
    """A GRU over time; where an episode began the memory is cleared first."""

    hidden: int

    @partial(nn.scan, variable_broadcast="params", in_axes=0, out_axes=0, split_rngs={"params": False})
    @nn.compact
    def __call__(self, memory, step):
        features, began = step
        memory = jnp.where(began[:, None], 0.0, memory)
        return nn.GRUCell(self.hidden)(memory, features)


class Net(nn.Module):
    """vector → h (tanh) → h (tanh) or GRU → outputs, for inputs [T, A, D]."""

    hidden: int
    outputs: int
    gain: float
    recurrent: bool

    @nn.compact
    def __call__(self, vectors, began, memory):
        def dense(width, gain):
            return nn.Dense(width, kernel_init=nn.initializers.orthogonal(gain))

        x = nn.tanh(dense(self.hidden, 2**0.5)(vectors))
        if self.recurrent:
            memory, x = Memory(self.hidden)(memory, (x, began))
        else:
            x = nn.tanh(dense(self.hidden, 2**0.5)(x))
        return dense(self.outputs, self.gain)(x), memory


def build(args):
    """(initial carry, one update: carry → carry and mean reward)."""
    env = SimpleSpreadMPE(num_agents=args.agents, num_landmarks=args.agents)
    n, rows, recurrent = args.agents, args.worlds * args.agents, args.policy == "mappo-gru"
    policy = Net(args.hidden, 5, 0.01, recurrent)
    value = Net(args.hidden, 1, 1.0, recurrent)
    optimiser = optax.chain(optax.clip_by_global_norm(10.0), optax.adam(args.rate, eps=1e-5))

    def flat(values):
        """{agent: [B, ...]} → [A, ...], world by world."""
        stacked = jnp.stack([values[agent] for agent in env.agents], axis=1)
        return stacked.reshape((rows,) + stacked.shape[2:])

    def critic_input(vectors, state):
        if not recurrent:
            return vectors
        team = jnp.concatenate([state.p_pos.reshape(args.worlds, -1), state.p_vel[:, :n].reshape(args.worlds, -1)], axis=1)
        return jnp.concatenate([vectors, jnp.repeat(team, n, axis=0)], axis=1)

    memories = (jnp.zeros((rows, args.hidden)), jnp.zeros((rows, args.hidden)))

    def init(key):
        keys = jax.random.split(key, 4)
        observations, state = jax.vmap(env.reset)(jax.random.split(keys[0], args.worlds))
        vectors, began = flat(observations), jnp.ones(rows, dtype=bool)
        seen = critic_input(vectors, state)
        params = (
            policy.init(keys[1], vectors[None], began[None], memories[0]),
            value.init(keys[2], seen[None], began[None], memories[1]),
        )
        return params, (optimiser.init(params[0]), optimiser.init(params[1])), state, vectors, began, memories, keys[3]

    def act(carry, _):
        params, state, vectors, began, (memory_p, memory_v), key = carry
        key, key_act, key_step = jax.random.split(key, 3)
        seen = critic_input(vectors, state)
        logits, next_p = policy.apply(params[0], vectors[None], began[None], memory_p)
        values, next_v = value.apply(params[1], seen[None], began[None], memory_v)
        actions = jax.random.categorical(key_act, logits[0])
        log_probs = jnp.take_along_axis(jax.nn.log_softmax(logits[0]), actions[:, None], axis=1)[:, 0]
        by_agent = actions.reshape(args.worlds, n)
        observations, state, rewards, ends, _ = jax.vmap(env.step)(
            jax.random.split(key_step, args.worlds), state, {agent: by_agent[:, i] for i, agent in enumerate(env.agents)}
        )
        ended = jnp.repeat(ends["__all__"], n)
        step = (vectors, seen, began, actions, log_probs, values[0, :, 0], flat(rewards), ended)
        return (params, state, flat(observations), ended, (next_p, next_v), key), step

    def advantages_of(values, last_value, rewards, ended):
        def back(carry, step):
            advantage, next_value = carry
            v, reward, end = step
            delta = reward + args.gamma * next_value * (1 - end) - v
            advantage = delta + args.gamma * args.gae_lambda * (1 - end) * advantage
            return (advantage, v), advantage

        start = (jnp.zeros_like(last_value), last_value)
        _, advantages = jax.lax.scan(back, start, (values, rewards, ended.astype(jnp.float32)), reverse=True)
        return advantages

    def losses(params, batch):
        vectors, seen, began, actions, old_log_probs, old_values, advantages, returns, memory_p, memory_v = batch

        def policy_loss(p):
            logits, _ = policy.apply(p, vectors, began, memory_p)
            log_all = jax.nn.log_softmax(logits)
            log_probs = jnp.take_along_axis(log_all, actions[..., None], axis=-1)[..., 0]
            ratio = jnp.exp(log_probs - old_log_probs)
            clipped = jnp.clip(ratio, 1 - args.clip, 1 + args.clip)
            entropy = -(jnp.exp(log_all) * log_all).sum(-1).mean()
            return -jnp.minimum(ratio * advantages, clipped * advantages).mean() - args.entropy * entropy

        def value_loss(p):
            values = value.apply(p, seen, began, memory_v)[0][..., 0]
            near = old_values + jnp.clip(values - old_values, -args.clip, args.clip)
            return jnp.maximum((values - returns) ** 2, (near - returns) ** 2).mean()

        return jax.grad(policy_loss)(params[0]), jax.grad(value_loss)(params[1])

    def update(carry, _):
        params, optimisers, state, vectors, began, memory, key = carry
        start = (params, state, vectors, began, memory, key)
        (params, state, vectors, began, next_memory, key), steps = jax.lax.scan(act, start, None, args.steps)
        all_vectors, seen, starts, actions, log_probs, values, rewards, ended = steps
        last, _ = value.apply(params[1], critic_input(vectors, state)[None], began[None], next_memory[1])
        advantages = advantages_of(values, last[0, :, 0], rewards, ended)
        returns = advantages + values
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        whole = (all_vectors, seen, starts, actions, log_probs, values, advantages, returns)

        def epoch(carry, _):
            params, optimisers, key = carry
            key, shuffle = jax.random.split(key)
            if recurrent:
                # Whole rollouts of some rows: [T, A / minibatches, ...].
                order = jax.random.permutation(shuffle, rows).reshape(args.minibatches, -1)
                parts = [jnp.moveaxis(x[:, order], 1, 0) for x in whole] + [m[order] for m in memory]
            else:
                # Single steps: [1, T·A / minibatches, ...].
                order = jax.random.permutation(shuffle, args.steps * rows).reshape(args.minibatches, 1, -1)
                parts = [x.reshape((-1,) + x.shape[2:])[order] for x in whole]
                parts += [jnp.zeros((args.minibatches, 1, args.hidden))] * 2

            def minibatch(carry, batch):
                params, optimisers = carry
                stepped = [
                    optimiser.update(gradient, o, p) for gradient, o, p in zip(losses(params, batch), optimisers, params)
                ]
                params = tuple(optax.apply_updates(p, delta) for p, (delta, _) in zip(params, stepped))
                return (params, tuple(o for _, o in stepped)), None

            (params, optimisers), _ = jax.lax.scan(minibatch, (params, optimisers), tuple(parts))
            return (params, optimisers, key), None

        (params, optimisers, key), _ = jax.lax.scan(epoch, (params, optimisers, key), None, args.epochs)
        return (params, optimisers, state, vectors, began, next_memory, key), rewards.mean()

    return init, update


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", choices=["ippo", "mappo-gru"], required=True)
    for name, default in [("agents", 5), ("worlds", 16), ("steps", 125), ("epochs", 4), ("minibatches", 4), ("hidden", 64)]:
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--iterations", type=int, default=20, help="updates that are timed")
    parser.add_argument("--seed", type=int, default=1)
    for name, default in [("rate", 1e-3), ("gamma", 0.99), ("gae-lambda", 0.95), ("clip", 0.2), ("entropy", 0.01)]:
        parser.add_argument(f"--{name}", type=float, default=default)
    args = parser.parse_args()
    if (args.worlds * args.agents * (1 if args.policy == "mappo-gru" else args.steps)) % args.minibatches:
        parser.error("--minibatches must divide the rows that are shuffled")

    init, update = build(args)
    carry = jax.jit(init)(jax.random.key(args.seed))
    run = jax.jit(lambda carry: jax.lax.scan(update, carry, None, args.iterations))
    began = time.perf_counter()
    compiled = run.lower(carry).compile()
    compile_s = time.perf_counter() - began
    # Once without being timed: the first run touches its memory for the first time.
    carry, first = jax.block_until_ready(compiled(carry))
    began = time.perf_counter()
    carry, rewards = jax.block_until_ready(compiled(carry))
    seconds = time.perf_counter() - began
    steps = args.iterations * args.steps * args.worlds
    print(json.dumps({
        "joint_env_steps_per_s": steps / seconds, "seconds": seconds, "joint_env_steps": steps, "compile_s": compile_s,
        "reward_first": float(first[0]), "reward_last": float(rewards[-1]),
    }))


if __name__ == "__main__":
    main()
