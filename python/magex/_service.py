"""EnvironmentService over grpcio."""

from __future__ import annotations

import contextlib
import json
import struct
import threading
import zlib
from collections.abc import Iterator
from typing import Any

import grpc
import numpy as np

from magex import _check, _probe
from magex._environment import Environment, Worlds
from magex._layout import Batch, Layout
from magex._problems import Problem, Refused, broke, describe, request
from magex._wire import environment_pb2 as pb
from magex._wire import types_pb2, environment_pb2_grpc

PROTOCOL = 1

_TYPES = {np.dtype(np.float32): types_pb2.DATA_TYPE_F32, np.dtype(np.float64): types_pb2.DATA_TYPE_F64}


class Service(environment_pb2_grpc.EnvironmentServiceServicer):
    """Every stream has worlds of its own; Describe is computed once."""

    def __init__(self, environment: Environment, deterministic: bool | None = None, successes: bool | None = None) -> None:
        self.environment = environment
        self.deterministic = deterministic
        self.successes = successes
        self._lock = threading.Lock()
        self._description: pb.EnvironmentDescription | None = None

    def Describe(self, message: pb.DescribeRequest, context: grpc.ServicerContext) -> pb.EnvironmentDescription:
        if message.protocol != PROTOCOL:
            context.abort(
                grpc.StatusCode.FAILED_PRECONDITION,
                f"protocol: {message.protocol}; this environment speaks {PROTOCOL}: install the magex package of your magex",
            )
        try:
            return self.description()
        except (Refused, Problem) as error:
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, str(error))
        except Exception as error:
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, f"make: {describe(error)}")
        raise AssertionError("abort raises")

    def description(self) -> pb.EnvironmentDescription:
        """What Describe answers; plays some steps the first time."""
        with self._lock:
            if self._description is None:
                layout = self.environment.layout()
                deterministic, successes = self.deterministic, self.successes
                if deterministic is None or successes is None:
                    found = _probe.play(self.environment, drop_state=True)
                    deterministic = found.deterministic if deterministic is None else deterministic
                    successes = found.successes if successes is None else successes
                self._description = describe_layout(layout, deterministic, successes)
            return self._description

    def Run(self, requests: Iterator[pb.EnvironmentRequest], context: grpc.ServicerContext) -> Iterator[pb.EnvironmentReply]:
        try:
            successes = self.description().successes
            stream = Stream(self.environment, successes)
        except Exception as error:
            text = str(error) if isinstance(error, (Refused, Problem)) else f"make: {describe(error)}"
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, text)
            return
        # Some clients wait for the head of the answer before they send a request.
        context.send_initial_metadata(())
        try:
            for message in requests:
                yield stream.answer(message)
        finally:
            stream.worlds.close()

    def Check(self, message: pb.CheckRequest, context: grpc.ServicerContext) -> pb.CheckReply:
        with contextlib.suppress(Exception):
            # What is decided once is decided before anything is checked. If it cannot be, the check says why.
            self.description()
        report = _check.check(self.environment, message.seed % 2**30, message.steps, self.deterministic)
        return pb.CheckReply(
            violations=[pb.Violation(rule=one.rule, sentence=one.sentence, warning=one.warning) for one in report.finish()],
            checked=list(report.checked),
            deterministic=report.deterministic,
            episodes=report.episodes,
            steps=report.steps,
        )


class Stream:
    """The worlds of one Run call."""

    def __init__(self, environment: Environment, successes: bool) -> None:
        self.layout = environment.layout()
        self.worlds: Worlds = environment.worlds()
        self.successes = successes
        self.count = 0
        # A failed request leaves worlds that were stepped beside worlds that were not.
        self.torn = True

    def answer(self, message: pb.EnvironmentRequest) -> pb.EnvironmentReply:
        which = message.WhichOneof("request")
        try:
            if which == "step":
                return pb.EnvironmentReply(observed=self._wire(self._step(message.step)))
            if which == "reset":
                return pb.EnvironmentReply(observed=self._wire(self._reset(message.reset)))
            if which == "render":
                return pb.EnvironmentReply(picture=pb.Picture(png=self._render(message.render.world)))
            raise request("request: empty; send reset, step or render")
        except Problem as problem:
            return pb.EnvironmentReply(
                problem=pb.EnvironmentProblem(kind=problem.kind, message=problem.message, world=problem.world)
            )
        except Exception as error:
            # Nothing of the environment's ends the stream, not even what is handled nowhere else.
            return pb.EnvironmentReply(problem=pb.EnvironmentProblem(kind=pb.ENVIRONMENT_PROBLEM_KIND_RAISED, message=describe(error)))

    def _reset(self, message: pb.EnvironmentReset) -> Batch:
        seeds = list(message.seeds)
        if not seeds:
            raise request("seeds: empty; send one for each world")
        limit = self.layout.worlds_max
        if limit and len(seeds) > limit:
            raise request(f"seeds: {len(seeds)} worlds; this environment has at most {limit}")
        for seed in seeds:
            _seed("seeds", seed)
        options: Any = None
        if message.options:
            try:
                options = json.loads(message.options)
            except ValueError as error:
                raise request(f"options: no JSON ({error}); send an object, or leave them empty") from None
            if not isinstance(options, dict):
                raise request(f"options: a JSON {type(options).__name__}; send an object, or leave them empty")
        self.torn = True
        batch = self.worlds.reset(seeds, options)
        self.count = len(seeds)
        self.torn = False
        return batch

    def _step(self, message: pb.EnvironmentStep) -> Batch:
        restarts = {}
        for restart in message.restarts:
            if restart.world >= self.count:
                raise request(f"restarts: world {restart.world}; there are {self.count}")
            if restart.world in restarts:
                raise request(f"restarts: world {restart.world} twice; name it once")
            _seed("restarts", restart.seed)
            restarts[restart.world] = restart.seed
        if self.torn and (not self.count or len(restarts) < self.count):
            raise request("step: no episode runs, for this is the first request or the last one failed; send a reset first")
        actions = self._actions(message.actions)
        # Problems that the caller caused leave the worlds as they are.
        torn, self.torn = self.torn, True
        try:
            batch = self.worlds.step(actions, restarts)
        except Problem as problem:
            if problem.kind == pb.ENVIRONMENT_PROBLEM_KIND_REQUEST:
                self.torn = torn
            raise
        self.torn = False
        return batch

    def _actions(self, array: types_pb2.Array) -> np.ndarray:
        table = self.layout.actions
        wanted, dtype = (
            (types_pb2.DATA_TYPE_U8, np.dtype(np.uint8)) if table.discrete else (types_pb2.DATA_TYPE_F32, np.dtype("<f4"))
        )
        shape = (self.count, len(self.layout.agents), table.size)
        if array.type != wanted:
            seen = types_pb2.DataType.Name(array.type)
            raise request(f"actions: type {seen}; expected {types_pb2.DataType.Name(wanted)}")
        if tuple(array.shape) != shape:
            raise request(f"actions: shape {tuple(array.shape)}; expected {shape}")
        expected = int(np.prod(shape)) * dtype.itemsize
        if len(array.data) != expected:
            raise request(f"actions: {len(array.data)} bytes; expected {expected}")
        numbers = np.frombuffer(array.data, dtype).reshape(shape)
        return numbers.astype(np.int64 if table.discrete else np.float64)

    def _render(self, world: int) -> bytes:
        if not self.layout.renders:
            raise request('render: this environment gives no pictures; make it with render_mode="rgb_array"')
        if world >= self.count or self.torn:
            raise request(f"render: world {world}; there are {0 if self.torn else self.count}")
        picture = self.worlds.render(world)
        try:
            return png(np.asarray(picture))
        except (TypeError, ValueError):
            raise broke(world, None, "render()", "an array [height, width, 3] of uint8", type(picture).__name__) from None

    def _wire(self, batch: Batch) -> pb.Observed:
        layout = self.layout
        return pb.Observed(
            observations=array(batch.observations),
            rewards=array(batch.rewards),
            terminated=batch.terminated.tobytes(),
            truncated=batch.truncated.tobytes(),
            active=batch.active.tobytes(),
            masks=b"" if batch.masks is None else batch.masks[:, :, layout.actions.on_wire].tobytes(),
            states=None if batch.states is None else array(batch.states),
            successes=batch.successes.tobytes() if self.successes else b"",
        )


def array(values: np.ndarray) -> types_pb2.Array:
    """An array of the wire, little-endian."""
    little = values.astype(values.dtype.newbyteorder("<"), copy=False)
    return types_pb2.Array(type=_TYPES[values.dtype], shape=values.shape, data=little.tobytes())


def describe_layout(layout: Layout, deterministic: bool, successes: bool) -> pb.EnvironmentDescription:
    table = layout.actions
    description = pb.EnvironmentDescription(
        protocol=PROTOCOL,
        name=layout.name,
        agents=layout.agents,
        observation_width=layout.width,
        observation_widths=[codec.width for codec in layout.observations],
        state_width=layout.state_width,
        masks=layout.masks,
        steps_max=layout.steps_max,
        deterministic=deterministic,
        renders=layout.renders,
        worlds_max=layout.worlds_max,
        successes=successes,
    )
    if table.discrete:
        description.discrete.choices.extend(int(n) for n in table.choices)
    else:
        description.continuous.low.extend(table.outer_low)
        description.continuous.high.extend(table.outer_high)
    return description


def png(picture: np.ndarray) -> bytes:
    """A picture [height, width, 3 or 4] uint8 as a PNG file. Written here so that no imaging package is needed."""
    if picture.ndim != 3 or picture.shape[2] not in (3, 4) or picture.dtype != np.uint8:
        raise ValueError("not a picture")
    height, width, channels = picture.shape
    # Every row begins with the number of its filter, 0: none.
    rows = np.zeros((height, 1 + width * channels), np.uint8)
    rows[:, 1:] = picture.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2 if channels == 3 else 6, 0, 0, 0)

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def _seed(field: str, seed: int) -> None:
    if seed >= 2**31:
        raise request(f"{field}: seed {seed}; it must be below 2^31")
