"""Joint steps a second through a Unix socket: one client, 64 worlds, random actions; worlds that are over are restarted.

    python benchmarks/bridge.py [module:callable ...] [--worlds 64] [--seconds 3]

A joint step is one step of one world, of all its agents. Client and environment wait for each other, so together they use one
core; "server" is the share of the environment's process, and steps/s/core what it would do with a core of its own.
"""

from __future__ import annotations

import argparse
import os
import queue
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import grpc
import numpy as np

from magex._wire import environment_pb2 as pb
from magex._wire import environment_pb2_grpc, types_pb2

HERE = Path(__file__).parent


def measure(environment: str, worlds: int, seconds: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        socket = f"{folder}/environment"
        process = subprocess.Popen(
            [sys.executable, "-m", "magex.serve", environment],
            stdin=subprocess.PIPE,
            cwd=HERE,
            env={
                **os.environ,
                "MAGEX_ENVIRONMENT_SOCKET": socket,
                "PYTHONPATH": f"{HERE.parent}:{os.environ.get('PYTHONPATH', '')}",
            },
        )
        try:
            with grpc.insecure_channel(f"unix:{socket}") as channel:
                grpc.channel_ready_future(channel).result(timeout=30)
                _drive(channel, process.pid, environment, worlds, seconds)
        finally:
            process.stdin.close()
            process.wait(timeout=10)


def _drive(channel: grpc.Channel, pid: int, environment: str, worlds: int, seconds: float) -> None:
    stub = environment_pb2_grpc.EnvironmentServiceStub(channel)
    description = stub.Describe(pb.DescribeRequest(protocol=1))
    requests: queue.SimpleQueue = queue.SimpleQueue()
    replies = stub.Run(iter(requests.get, None))
    requests.put(pb.EnvironmentRequest(reset=pb.EnvironmentReset(seeds=range(worlds))))
    next(replies)
    count = len(description.agents)
    discrete = description.WhichOneof("action") == "discrete"
    rng = np.random.default_rng(1)
    if discrete:
        sizes = (worlds, count, len(description.discrete.choices))
        actions = [rng.integers(0, description.discrete.choices, sizes).astype(np.uint8) for _ in range(16)]
    else:
        low, high = np.array(description.continuous.low), np.array(description.continuous.high)
        actions = [rng.uniform(low, high, (worlds, count, len(low))).astype(np.float32) for _ in range(16)]
    kind = types_pb2.DATA_TYPE_U8 if discrete else types_pb2.DATA_TYPE_F32
    arrays = [types_pb2.Array(type=kind, shape=a.shape, data=a.tobytes()) for a in actions]
    calls, restarts, seed = 0, [], worlds
    busy, begun = cpu(pid), time.perf_counter()
    while time.perf_counter() - begun < seconds:
        requests.put(pb.EnvironmentRequest(step=pb.EnvironmentStep(actions=arrays[calls % 16], restarts=restarts)))
        reply = next(replies)
        if reply.WhichOneof("reply") != "observed":
            raise SystemExit(reply.problem.message)
        active = np.frombuffer(reply.observed.active, np.uint8).reshape(worlds, count)
        restarts = []
        for world in np.flatnonzero(~active.any(axis=1)):
            seed += 1
            restarts.append(pb.Restart(world=int(world), seed=seed))
        calls += 1
    passed, busy = time.perf_counter() - begun, cpu(pid) - busy
    requests.put(None)
    steps = calls * worlds
    print(
        f"{environment}: {steps / passed:,.0f} joint steps/s, {1e6 * passed / calls:,.0f} us a call; "
        f"server {busy / passed:.0%} of a core, {steps / busy:,.0f} steps/s/core"
    )


def cpu(pid: int) -> float:
    """Seconds of processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environments", nargs="*", default=["worlds:Objects", "worlds:Arrays"])
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=3.0)
    options = parser.parse_args()
    for environment in options.environments:
        measure(environment, options.worlds, options.seconds)


if __name__ == "__main__":
    main()
