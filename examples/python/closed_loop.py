"""A robot loop: goals from the commander, actions from the policy, steps in mpe2's Simple Spread.

    python3 -m pip install -r examples/python/requirements.txt -r examples/python/requirements-policy.txt
    magex commander --weights RUN &
    python3 examples/python/closed_loop.py 127.0.0.1:7100 [EPISODES] [STEPS] [LEAST]

Generate the stubs as in client.py, with magex/v1/policy.proto as a third file. RUN is a run of Simple Spread for 5 agents.

Two things differ between mpe2 and the world that a policy was trained in. Action 1 is -x there, so indices are mapped. And mpe2 moves
agents with the velocity of the step before, so that every action arrives one step later, and contacts act on places that agents have
left. The example shows the loop as it is, and in a world patched to integrate velocity first. With LEAST it fails if the patched one
covers fewer landmarks.
"""

import sys

import mpe2.simple_spread_v3 as simple_spread
import numpy as np
from client import connect, positions
from magex.v1 import commander_pb2 as pb
from magex.v1 import commander_pb2_grpc, policy_pb2, policy_pb2_grpc
from magex.v1 import types_pb2 as types

AGENTS = 5
# MAGE-X: none, +x, -x, +y, -y. mpe2: none, -x, +x, -y, +y.
TO_MPE2 = [0, 2, 1, 4, 3]


def velocity_first(world):
    """Lets a world integrate as MAGE-X does: the new velocity moves the body."""

    def integrate(forces):
        for body, force in zip(world.entities, forces):
            if body.movable:
                push = 0 if force is None else force / body.mass
                body.state.p_vel = body.state.p_vel * (1 - world.damping) + push * world.dt
                body.state.p_pos = body.state.p_pos + body.state.p_vel * world.dt

    world.integrate_state = integrate


def episode(commander, policy, metadata, seed, steps, how):
    env = simple_spread.parallel_env(N=AGENTS, max_cycles=steps, continuous_actions=False)
    env.reset(seed=seed)
    world = env.unwrapped.world
    if how == "velocity first":
        velocity_first(world)
    landmarks = np.array([landmark.state.p_pos for landmark in world.landmarks])
    start = positions([list(agent.state.p_pos) for agent in world.agents])
    team = pb.AssignRequest(agents=start, goals=positions(landmarks.tolist()), scheduler=types.ASSIGNMENT_METHOD_EXACT)
    pairs = commander.Assign(team, metadata=metadata, timeout=5).pairs
    goals = np.zeros((AGENTS, 2))
    for pair in pairs:
        goals[pair.agent_index] = landmarks[pair.goal_index]
    memory = b""
    for _ in range(steps):
        place = np.array([agent.state.p_pos for agent in world.agents])
        speed = np.array([agent.state.p_vel for agent in world.agents])
        step = policy_pb2.ActRequest(
            dims=2, positions=place.ravel(), velocities=speed.ravel(), goals=goals.ravel(), memory=memory
        )
        answer = policy.Act(step, metadata=metadata, timeout=5)
        memory = answer.memory
        env.step({agent: TO_MPE2[action] for agent, action in zip(env.agents, answer.actions)})
    place = np.array([agent.state.p_pos for agent in world.agents])
    distance = np.linalg.norm(landmarks[:, None] - place[None], axis=2)
    env.close()
    return float((distance.min(1) <= 0.15).mean())


def main():
    address, *rest = sys.argv[1:]
    episodes, steps = (int(rest[k]) if len(rest) > k else default for k, default in enumerate((30, 60)))
    least = float(rest[2]) if len(rest) > 2 else 0.0
    channel, metadata = connect(address)
    commander = commander_pb2_grpc.CommanderServiceStub(channel)
    policy = policy_pb2_grpc.PolicyServiceStub(channel)
    covered = {}
    for how in ("as it is", "velocity first"):
        shares = [episode(commander, policy, metadata, seed, steps, how) for seed in range(episodes)]
        covered[how] = float(np.mean(shares))
        print(f"{how}: {covered[how]:.3f} of the landmarks covered in {episodes} episodes")
    if covered["velocity first"] < least:
        raise SystemExit(f"fewer than {least} of the landmarks were covered")


if __name__ == "__main__":
    main()
