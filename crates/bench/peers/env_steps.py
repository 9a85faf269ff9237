"""Simple Spread alone, random actions, many worlds at once: steps per second of jaxmarl's compiled scan or of vmas."""

import argparse
import json
import time


def jaxmarl_steps(args):
    import jax
    from jaxmarl.environments.mpe.simple_spread import SimpleSpreadMPE

    env = SimpleSpreadMPE(num_agents=args.agents, num_landmarks=args.agents)

    def step(carry, _):
        state, key = carry
        key, key_act, key_step = jax.random.split(key, 3)
        actions = jax.random.randint(key_act, (len(env.agents), args.worlds), 0, 5)
        seen, state, rewards, _, _ = jax.vmap(env.step)(
            jax.random.split(key_step, args.worlds), state, dict(zip(env.agents, actions))
        )
        # Sums keep the compiler from leaving out what is not read.
        return (state, key), (sum(x.sum() for x in seen.values()), sum(x.sum() for x in rewards.values()))

    _, state = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), args.worlds))
    carry = (state, jax.random.key(2))
    run = jax.jit(lambda carry: jax.lax.scan(step, carry, None, args.steps)).lower(carry).compile()
    carry, _ = jax.block_until_ready(run(carry))
    began = time.perf_counter()
    jax.block_until_ready(run(carry))
    return time.perf_counter() - began


def vmas_steps(args):
    import torch
    import vmas

    env = vmas.make_env(
        "simple_spread", args.worlds, n_agents=args.agents, continuous_actions=False, device="cpu", seed=1
    )
    env.reset()

    def run(steps):
        for t in range(steps):
            # Its episodes do not end by themselves.
            if t % 25 == 0:
                env.reset()
            env.step([torch.randint(0, 5, (args.worlds, 1)) for _ in env.agents])

    run(2)
    began = time.perf_counter()
    run(args.steps)
    return time.perf_counter() - began


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("peer", choices=["jaxmarl", "vmas"])
    for name, default in [("agents", 5), ("worlds", 1024), ("steps", 50)]:
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()
    seconds = {"jaxmarl": jaxmarl_steps, "vmas": vmas_steps}[args.peer](args)
    print(json.dumps({"env_steps_per_s": args.worlds * args.steps / seconds, "seconds": seconds}))


if __name__ == "__main__":
    main()
