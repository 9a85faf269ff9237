from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DataType(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DATA_TYPE_UNSPECIFIED: _ClassVar[DataType]
    DATA_TYPE_F32: _ClassVar[DataType]
    DATA_TYPE_U32: _ClassVar[DataType]
    DATA_TYPE_U8: _ClassVar[DataType]
    DATA_TYPE_F64: _ClassVar[DataType]

class ShardKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SHARD_KIND_UNSPECIFIED: _ClassVar[ShardKind]
    SHARD_KIND_TRAIN: _ClassVar[ShardKind]
    SHARD_KIND_EVAL: _ClassVar[ShardKind]

class Mode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MODE_UNSPECIFIED: _ClassVar[Mode]
    MODE_SAMPLED: _ClassVar[Mode]
    MODE_GREEDY: _ClassVar[Mode]

class AssignmentMethod(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ASSIGNMENT_METHOD_UNSPECIFIED: _ClassVar[AssignmentMethod]
    ASSIGNMENT_METHOD_LEARNED: _ClassVar[AssignmentMethod]
    ASSIGNMENT_METHOD_EXACT: _ClassVar[AssignmentMethod]
    ASSIGNMENT_METHOD_GREEDY: _ClassVar[AssignmentMethod]
    ASSIGNMENT_METHOD_RANDOM: _ClassVar[AssignmentMethod]
    ASSIGNMENT_METHOD_MAKESPAN: _ClassVar[AssignmentMethod]
DATA_TYPE_UNSPECIFIED: DataType
DATA_TYPE_F32: DataType
DATA_TYPE_U32: DataType
DATA_TYPE_U8: DataType
DATA_TYPE_F64: DataType
SHARD_KIND_UNSPECIFIED: ShardKind
SHARD_KIND_TRAIN: ShardKind
SHARD_KIND_EVAL: ShardKind
MODE_UNSPECIFIED: Mode
MODE_SAMPLED: Mode
MODE_GREEDY: Mode
ASSIGNMENT_METHOD_UNSPECIFIED: AssignmentMethod
ASSIGNMENT_METHOD_LEARNED: AssignmentMethod
ASSIGNMENT_METHOD_EXACT: AssignmentMethod
ASSIGNMENT_METHOD_GREEDY: AssignmentMethod
ASSIGNMENT_METHOD_RANDOM: AssignmentMethod
ASSIGNMENT_METHOD_MAKESPAN: AssignmentMethod

class Array(_message.Message):
    __slots__ = ("type", "shape", "data")
    TYPE_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    type: DataType
    shape: _containers.RepeatedScalarFieldContainer[int]
    data: bytes
    def __init__(self, type: _Optional[_Union[DataType, str]] = ..., shape: _Optional[_Iterable[int]] = ..., data: _Optional[bytes] = ...) -> None: ...

class Shard(_message.Message):
    __slots__ = ("kind", "iteration", "index", "episodes", "first_episode", "version", "mode", "eval_set", "record")
    KIND_FIELD_NUMBER: _ClassVar[int]
    ITERATION_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    FIRST_EPISODE_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    EVAL_SET_FIELD_NUMBER: _ClassVar[int]
    RECORD_FIELD_NUMBER: _ClassVar[int]
    kind: ShardKind
    iteration: int
    index: int
    episodes: int
    first_episode: int
    version: int
    mode: Mode
    eval_set: int
    record: bool
    def __init__(self, kind: _Optional[_Union[ShardKind, str]] = ..., iteration: _Optional[int] = ..., index: _Optional[int] = ..., episodes: _Optional[int] = ..., first_episode: _Optional[int] = ..., version: _Optional[int] = ..., mode: _Optional[_Union[Mode, str]] = ..., eval_set: _Optional[int] = ..., record: bool = ...) -> None: ...

class Shape(_message.Message):
    __slots__ = ("steps", "episodes", "agents", "bodies", "landmarks", "dims", "goals_per_agent", "action_components", "agent_state", "world_state", "moves", "masks", "marks")
    STEPS_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    AGENTS_FIELD_NUMBER: _ClassVar[int]
    BODIES_FIELD_NUMBER: _ClassVar[int]
    LANDMARKS_FIELD_NUMBER: _ClassVar[int]
    DIMS_FIELD_NUMBER: _ClassVar[int]
    GOALS_PER_AGENT_FIELD_NUMBER: _ClassVar[int]
    ACTION_COMPONENTS_FIELD_NUMBER: _ClassVar[int]
    AGENT_STATE_FIELD_NUMBER: _ClassVar[int]
    WORLD_STATE_FIELD_NUMBER: _ClassVar[int]
    MOVES_FIELD_NUMBER: _ClassVar[int]
    MASKS_FIELD_NUMBER: _ClassVar[int]
    MARKS_FIELD_NUMBER: _ClassVar[int]
    steps: int
    episodes: int
    agents: int
    bodies: int
    landmarks: int
    dims: int
    goals_per_agent: int
    action_components: int
    agent_state: int
    world_state: int
    moves: int
    masks: int
    marks: int
    def __init__(self, steps: _Optional[int] = ..., episodes: _Optional[int] = ..., agents: _Optional[int] = ..., bodies: _Optional[int] = ..., landmarks: _Optional[int] = ..., dims: _Optional[int] = ..., goals_per_agent: _Optional[int] = ..., action_components: _Optional[int] = ..., agent_state: _Optional[int] = ..., world_state: _Optional[int] = ..., moves: _Optional[int] = ..., masks: _Optional[int] = ..., marks: _Optional[int] = ...) -> None: ...

class NamedArray(_message.Message):
    __slots__ = ("name", "array")
    NAME_FIELD_NUMBER: _ClassVar[int]
    ARRAY_FIELD_NUMBER: _ClassVar[int]
    name: str
    array: Array
    def __init__(self, name: _Optional[str] = ..., array: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class Trajectory(_message.Message):
    __slots__ = ("shape", "positions", "velocities", "goals", "actions", "log_probs", "rewards", "goal_log_probs", "costs", "exact_costs", "agent_state", "metrics", "statics", "moves", "masks", "marks", "world_states")
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    POSITIONS_FIELD_NUMBER: _ClassVar[int]
    VELOCITIES_FIELD_NUMBER: _ClassVar[int]
    GOALS_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    LOG_PROBS_FIELD_NUMBER: _ClassVar[int]
    REWARDS_FIELD_NUMBER: _ClassVar[int]
    GOAL_LOG_PROBS_FIELD_NUMBER: _ClassVar[int]
    COSTS_FIELD_NUMBER: _ClassVar[int]
    EXACT_COSTS_FIELD_NUMBER: _ClassVar[int]
    AGENT_STATE_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    STATICS_FIELD_NUMBER: _ClassVar[int]
    MOVES_FIELD_NUMBER: _ClassVar[int]
    MASKS_FIELD_NUMBER: _ClassVar[int]
    MARKS_FIELD_NUMBER: _ClassVar[int]
    WORLD_STATES_FIELD_NUMBER: _ClassVar[int]
    shape: Shape
    positions: Array
    velocities: Array
    goals: Array
    actions: Array
    log_probs: Array
    rewards: Array
    goal_log_probs: Array
    costs: Array
    exact_costs: Array
    agent_state: Array
    metrics: Array
    statics: _containers.RepeatedCompositeFieldContainer[NamedArray]
    moves: Array
    masks: Array
    marks: Array
    world_states: Array
    def __init__(self, shape: _Optional[_Union[Shape, _Mapping]] = ..., positions: _Optional[_Union[Array, _Mapping]] = ..., velocities: _Optional[_Union[Array, _Mapping]] = ..., goals: _Optional[_Union[Array, _Mapping]] = ..., actions: _Optional[_Union[Array, _Mapping]] = ..., log_probs: _Optional[_Union[Array, _Mapping]] = ..., rewards: _Optional[_Union[Array, _Mapping]] = ..., goal_log_probs: _Optional[_Union[Array, _Mapping]] = ..., costs: _Optional[_Union[Array, _Mapping]] = ..., exact_costs: _Optional[_Union[Array, _Mapping]] = ..., agent_state: _Optional[_Union[Array, _Mapping]] = ..., metrics: _Optional[_Union[Array, _Mapping]] = ..., statics: _Optional[_Iterable[_Union[NamedArray, _Mapping]]] = ..., moves: _Optional[_Union[Array, _Mapping]] = ..., masks: _Optional[_Union[Array, _Mapping]] = ..., marks: _Optional[_Union[Array, _Mapping]] = ..., world_states: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class Recording(_message.Message):
    __slots__ = ("shape", "positions", "goals", "agent_state", "statics", "pictures")
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    POSITIONS_FIELD_NUMBER: _ClassVar[int]
    GOALS_FIELD_NUMBER: _ClassVar[int]
    AGENT_STATE_FIELD_NUMBER: _ClassVar[int]
    STATICS_FIELD_NUMBER: _ClassVar[int]
    PICTURES_FIELD_NUMBER: _ClassVar[int]
    shape: Shape
    positions: Array
    goals: Array
    agent_state: Array
    statics: _containers.RepeatedCompositeFieldContainer[NamedArray]
    pictures: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, shape: _Optional[_Union[Shape, _Mapping]] = ..., positions: _Optional[_Union[Array, _Mapping]] = ..., goals: _Optional[_Union[Array, _Mapping]] = ..., agent_state: _Optional[_Union[Array, _Mapping]] = ..., statics: _Optional[_Iterable[_Union[NamedArray, _Mapping]]] = ..., pictures: _Optional[_Iterable[str]] = ...) -> None: ...

class EvalOutcome(_message.Message):
    __slots__ = ("recording", "metrics")
    RECORDING_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    recording: Recording
    metrics: Array
    def __init__(self, recording: _Optional[_Union[Recording, _Mapping]] = ..., metrics: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class ShardResult(_message.Message):
    __slots__ = ("run_id", "shard", "weights_sha256", "trajectory", "eval")
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    SHARD_FIELD_NUMBER: _ClassVar[int]
    WEIGHTS_SHA256_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_FIELD_NUMBER: _ClassVar[int]
    EVAL_FIELD_NUMBER: _ClassVar[int]
    run_id: str
    shard: Shard
    weights_sha256: str
    trajectory: Trajectory
    eval: EvalOutcome
    def __init__(self, run_id: _Optional[str] = ..., shard: _Optional[_Union[Shard, _Mapping]] = ..., weights_sha256: _Optional[str] = ..., trajectory: _Optional[_Union[Trajectory, _Mapping]] = ..., eval: _Optional[_Union[EvalOutcome, _Mapping]] = ...) -> None: ...

class Part(_message.Message):
    __slots__ = ("index", "total", "total_bytes", "crc32c", "data")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    TOTAL_BYTES_FIELD_NUMBER: _ClassVar[int]
    CRC32C_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    index: int
    total: int
    total_bytes: int
    crc32c: int
    data: bytes
    def __init__(self, index: _Optional[int] = ..., total: _Optional[int] = ..., total_bytes: _Optional[int] = ..., crc32c: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...
