"""A real server in this process, and a client for it."""

from __future__ import annotations

import queue
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from magex._environment import Environment
from magex._server import start
from magex._service import Service
from magex._wire import environment_pb2 as pb
from magex._wire import environment_pb2_grpc, types_pb2

DTYPES = {types_pb2.DATA_TYPE_F32: "<f4", types_pb2.DATA_TYPE_F64: "<f8"}


class Observed:
    """A reply with its arrays."""

    def __init__(self, message: pb.Observed) -> None:
        self.message = message
        self.observations = read(message.observations)
        self.rewards = read(message.rewards)
        worlds, agents = self.rewards.shape
        for name in ("terminated", "truncated", "active"):
            setattr(self, name, np.frombuffer(getattr(message, name), np.uint8).reshape(worlds, agents).tolist())
        self.masks = np.frombuffer(message.masks, np.uint8).reshape(worlds, agents, -1) if message.masks else None
        self.states = read(message.states) if message.HasField("states") else None
        self.successes = list(message.successes)


def read(array: types_pb2.Array) -> np.ndarray:
    return np.frombuffer(array.data, DTYPES[array.type]).reshape(array.shape)


class Run:
    """One stream."""

    def __init__(self, stub: Any) -> None:
        self.requests: queue.SimpleQueue = queue.SimpleQueue()
        self.replies = stub.Run(iter(self.requests.get, None))
        self.description = stub.Describe(pb.DescribeRequest(protocol=1))

    def send(self, **request: Any) -> Any:
        self.requests.put(pb.EnvironmentRequest(**request))
        reply = next(self.replies)
        which = reply.WhichOneof("reply")
        return Observed(reply.observed) if which == "observed" else getattr(reply, which)

    def reset(self, *seeds: int, options: str = "") -> Any:
        self.worlds = len(seeds)
        return self.send(reset=pb.EnvironmentReset(seeds=seeds, options=options))

    def step(self, actions: Any = 1, restarts: dict[int, int] | None = None) -> Any:
        discrete = self.description.WhichOneof("action") == "discrete"
        size = len(self.description.discrete.choices if discrete else self.description.continuous.low)
        numbers = np.zeros((self.worlds, len(self.description.agents), size), np.uint8 if discrete else np.float32)
        numbers[:] = actions
        kind = types_pb2.DATA_TYPE_U8 if discrete else types_pb2.DATA_TYPE_F32
        return self.send(
            step=pb.EnvironmentStep(
                actions=types_pb2.Array(type=kind, shape=numbers.shape, data=numbers.tobytes()),
                restarts=[pb.Restart(world=w, seed=seed) for w, seed in (restarts or {}).items()],
            )
        )

    def render(self, world: int) -> Any:
        return self.send(render=pb.EnvironmentRender(world=world))

    def close(self) -> None:
        self.requests.put(None)
        assert list(self.replies) == []


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """served(make, ...) returns a stub."""
    open_things: list[Any] = []

    def serve(make: Callable, deterministic: bool | None = None, successes: bool | None = None, **options: Any) -> Any:
        path = tmp_path / f"socket{len(open_things)}"
        server, _ = start(Service(Environment(make, **options), deterministic, successes), f"unix:{path}")
        channel = grpc.insecure_channel(f"unix:{path}")
        open_things.extend((channel, server))
        return environment_pb2_grpc.EnvironmentServiceStub(channel)

    yield serve
    for thing in open_things:
        if isinstance(thing, grpc.Channel):
            thing.close()
        else:
            thing.stop(None).wait()


@pytest.fixture
def run(served: Callable[..., Any]) -> Callable[..., Run]:
    """run(make, ...) returns a stream."""
    return lambda make, **options: Run(served(make, **options))


def refused(stub: Any) -> str:
    """The sentence with which Describe refuses."""
    with pytest.raises(grpc.RpcError) as error:
        stub.Describe(pb.DescribeRequest(protocol=1))
    assert error.value.code() == grpc.StatusCode.FAILED_PRECONDITION
    return error.value.details()
