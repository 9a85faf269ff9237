"""Records orca.json: scenes, and the velocities that RVO2 chooses in them.

pip install pyrvo==0.4.3 (RVO2 in single precision, Python binding), then: python record_orca.py > orca.json
"""

import json
import math
import random

import pyrvo

TIME_STEP, NEIGHBOUR_DISTANCE, MAX_NEIGHBOURS, TIME_HORIZON, RADIUS, MAX_SPEED = 0.1, 2.0, 10, 1.0, 0.1, 2.0


def single(x):
    """The nearest number that single precision has and a short text tells."""
    return round(x, 4)


def scene(name, positions, velocities, preferred):
    simulator = pyrvo.RVOSimulator(
        TIME_STEP, NEIGHBOUR_DISTANCE, MAX_NEIGHBOURS, TIME_HORIZON, 1.0, RADIUS, MAX_SPEED
    )
    numbers = [[[single(x) for x in vector] for vector in group] for group in (positions, velocities, preferred)]
    positions, velocities, preferred = numbers
    for position, velocity, wanted in zip(*numbers):
        agent = simulator.add_agent(tuple(position))
        simulator.set_agent_velocity(agent, tuple(velocity))
        simulator.set_agent_pref_velocity(agent, tuple(wanted))
    simulator.do_step()
    chosen = [simulator.get_agent_velocity(k).to_tuple() for k in range(len(positions))]
    return {
        "name": name,
        "positions": positions,
        "velocities": velocities,
        "preferred": preferred,
        "chosen": [[round(x, 6) for x in velocity] for velocity in chosen],
    }


def drawn(name, agents, side, speed, seed):
    stream = random.Random(seed)

    def vectors(length):
        return [[stream.uniform(-length, length) for _ in range(2)] for _ in range(agents)]

    return scene(name, vectors(side / 2), vectors(speed), vectors(speed))


def circle(agents, radius):
    angles = [2 * math.pi * k / agents + 0.05 * k for k in range(agents)]
    positions = [[radius * math.cos(a), radius * math.sin(a)] for a in angles]
    # Below the largest speed: at it, rounding of the input decides which way round an agent goes.
    inwards = [[-1.2 * math.cos(a), -1.2 * math.sin(a)] for a in angles]
    return scene("circle", positions, inwards, inwards)


SCENES = [
    scene("alone and too fast", [[0.0, 0.0]], [[0.0, 0.0]], [[3.0, 4.0]]),
    scene("head on", [[0.0, 0.0], [1.0, 0.05]], [[1.0, 0.0], [-1.0, 0.0]], [[2.0, 0.0], [-2.0, 0.0]]),
    scene("passed", [[0.0, 0.0], [-0.5, 0.0]], [[1.0, 0.0], [-1.0, 0.1]], [[2.0, 0.0], [-2.0, 0.0]]),
    scene("overlap", [[0.0, 0.0], [0.12, 0.05]], [[0.1, 0.0], [0.0, 0.1]], [[1.0, 0.0], [-1.0, 0.0]]),
    scene("crossing", [[0.0, 0.0], [0.7, -0.7]], [[1.0, 0.0], [0.0, 1.0]], [[1.5, 0.0], [0.0, 1.5]]),
    circle(6, 1.0),
    drawn("open, 12 agents", 12, 6.0, 1.2, 1),
    drawn("busy, 25 agents", 25, 3.0, 1.4, 2),
    drawn("packed, 40 agents", 40, 1.6, 1.0, 3),
    drawn("overlapping, 30 agents", 30, 0.8, 0.5, 4),
]

print("{")
print(' "source": "RVO2, pyrvo 0.4.3, single precision; record_orca.py",')
settings = {
    "time_step": TIME_STEP,
    "neighbour_distance": NEIGHBOUR_DISTANCE,
    "max_neighbours": MAX_NEIGHBOURS,
    "time_horizon": TIME_HORIZON,
    "radius": RADIUS,
    "max_speed": MAX_SPEED,
}
print(f' "settings": {json.dumps(settings)},')
print(' "scenes": [')
print(",\n".join("  " + json.dumps(one) for one in SCENES))
print(" ]\n}")
