from magex._wire import types_pb2 as _types_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class EnvironmentProblemKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ENVIRONMENT_PROBLEM_KIND_UNSPECIFIED: _ClassVar[EnvironmentProblemKind]
    ENVIRONMENT_PROBLEM_KIND_RAISED: _ClassVar[EnvironmentProblemKind]
    ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD: _ClassVar[EnvironmentProblemKind]
    ENVIRONMENT_PROBLEM_KIND_REQUEST: _ClassVar[EnvironmentProblemKind]
ENVIRONMENT_PROBLEM_KIND_UNSPECIFIED: EnvironmentProblemKind
ENVIRONMENT_PROBLEM_KIND_RAISED: EnvironmentProblemKind
ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD: EnvironmentProblemKind
ENVIRONMENT_PROBLEM_KIND_REQUEST: EnvironmentProblemKind

class DescribeRequest(_message.Message):
    __slots__ = ("protocol",)
    PROTOCOL_FIELD_NUMBER: _ClassVar[int]
    protocol: int
    def __init__(self, protocol: _Optional[int] = ...) -> None: ...

class EnvironmentDescription(_message.Message):
    __slots__ = ("protocol", "name", "agents", "observation_width", "observation_widths", "discrete", "continuous", "state_width", "masks", "steps_max", "deterministic", "renders", "worlds_max", "successes")
    PROTOCOL_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    AGENTS_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_WIDTH_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_WIDTHS_FIELD_NUMBER: _ClassVar[int]
    DISCRETE_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_FIELD_NUMBER: _ClassVar[int]
    STATE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    MASKS_FIELD_NUMBER: _ClassVar[int]
    STEPS_MAX_FIELD_NUMBER: _ClassVar[int]
    DETERMINISTIC_FIELD_NUMBER: _ClassVar[int]
    RENDERS_FIELD_NUMBER: _ClassVar[int]
    WORLDS_MAX_FIELD_NUMBER: _ClassVar[int]
    SUCCESSES_FIELD_NUMBER: _ClassVar[int]
    protocol: int
    name: str
    agents: _containers.RepeatedScalarFieldContainer[str]
    observation_width: int
    observation_widths: _containers.RepeatedScalarFieldContainer[int]
    discrete: DiscreteAction
    continuous: ContinuousAction
    state_width: int
    masks: bool
    steps_max: int
    deterministic: bool
    renders: bool
    worlds_max: int
    successes: bool
    def __init__(self, protocol: _Optional[int] = ..., name: _Optional[str] = ..., agents: _Optional[_Iterable[str]] = ..., observation_width: _Optional[int] = ..., observation_widths: _Optional[_Iterable[int]] = ..., discrete: _Optional[_Union[DiscreteAction, _Mapping]] = ..., continuous: _Optional[_Union[ContinuousAction, _Mapping]] = ..., state_width: _Optional[int] = ..., masks: bool = ..., steps_max: _Optional[int] = ..., deterministic: bool = ..., renders: bool = ..., worlds_max: _Optional[int] = ..., successes: bool = ...) -> None: ...

class DiscreteAction(_message.Message):
    __slots__ = ("choices",)
    CHOICES_FIELD_NUMBER: _ClassVar[int]
    choices: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, choices: _Optional[_Iterable[int]] = ...) -> None: ...

class ContinuousAction(_message.Message):
    __slots__ = ("low", "high")
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    low: _containers.RepeatedScalarFieldContainer[float]
    high: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, low: _Optional[_Iterable[float]] = ..., high: _Optional[_Iterable[float]] = ...) -> None: ...

class EnvironmentRequest(_message.Message):
    __slots__ = ("reset", "step", "render")
    RESET_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    RENDER_FIELD_NUMBER: _ClassVar[int]
    reset: EnvironmentReset
    step: EnvironmentStep
    render: EnvironmentRender
    def __init__(self, reset: _Optional[_Union[EnvironmentReset, _Mapping]] = ..., step: _Optional[_Union[EnvironmentStep, _Mapping]] = ..., render: _Optional[_Union[EnvironmentRender, _Mapping]] = ...) -> None: ...

class EnvironmentReset(_message.Message):
    __slots__ = ("seeds", "options")
    SEEDS_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    seeds: _containers.RepeatedScalarFieldContainer[int]
    options: str
    def __init__(self, seeds: _Optional[_Iterable[int]] = ..., options: _Optional[str] = ...) -> None: ...

class EnvironmentStep(_message.Message):
    __slots__ = ("actions", "restarts")
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    RESTARTS_FIELD_NUMBER: _ClassVar[int]
    actions: _types_pb2.Array
    restarts: _containers.RepeatedCompositeFieldContainer[Restart]
    def __init__(self, actions: _Optional[_Union[_types_pb2.Array, _Mapping]] = ..., restarts: _Optional[_Iterable[_Union[Restart, _Mapping]]] = ...) -> None: ...

class Restart(_message.Message):
    __slots__ = ("world", "seed")
    WORLD_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    world: int
    seed: int
    def __init__(self, world: _Optional[int] = ..., seed: _Optional[int] = ...) -> None: ...

class EnvironmentRender(_message.Message):
    __slots__ = ("world",)
    WORLD_FIELD_NUMBER: _ClassVar[int]
    world: int
    def __init__(self, world: _Optional[int] = ...) -> None: ...

class EnvironmentReply(_message.Message):
    __slots__ = ("observed", "picture", "problem")
    OBSERVED_FIELD_NUMBER: _ClassVar[int]
    PICTURE_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    observed: Observed
    picture: Picture
    problem: EnvironmentProblem
    def __init__(self, observed: _Optional[_Union[Observed, _Mapping]] = ..., picture: _Optional[_Union[Picture, _Mapping]] = ..., problem: _Optional[_Union[EnvironmentProblem, _Mapping]] = ...) -> None: ...

class Observed(_message.Message):
    __slots__ = ("observations", "rewards", "terminated", "truncated", "active", "masks", "states", "successes")
    OBSERVATIONS_FIELD_NUMBER: _ClassVar[int]
    REWARDS_FIELD_NUMBER: _ClassVar[int]
    TERMINATED_FIELD_NUMBER: _ClassVar[int]
    TRUNCATED_FIELD_NUMBER: _ClassVar[int]
    ACTIVE_FIELD_NUMBER: _ClassVar[int]
    MASKS_FIELD_NUMBER: _ClassVar[int]
    STATES_FIELD_NUMBER: _ClassVar[int]
    SUCCESSES_FIELD_NUMBER: _ClassVar[int]
    observations: _types_pb2.Array
    rewards: _types_pb2.Array
    terminated: bytes
    truncated: bytes
    active: bytes
    masks: bytes
    states: _types_pb2.Array
    successes: bytes
    def __init__(self, observations: _Optional[_Union[_types_pb2.Array, _Mapping]] = ..., rewards: _Optional[_Union[_types_pb2.Array, _Mapping]] = ..., terminated: _Optional[bytes] = ..., truncated: _Optional[bytes] = ..., active: _Optional[bytes] = ..., masks: _Optional[bytes] = ..., states: _Optional[_Union[_types_pb2.Array, _Mapping]] = ..., successes: _Optional[bytes] = ...) -> None: ...

class Picture(_message.Message):
    __slots__ = ("png",)
    PNG_FIELD_NUMBER: _ClassVar[int]
    png: bytes
    def __init__(self, png: _Optional[bytes] = ...) -> None: ...

class EnvironmentProblem(_message.Message):
    __slots__ = ("kind", "message", "world")
    KIND_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    kind: EnvironmentProblemKind
    message: str
    world: int
    def __init__(self, kind: _Optional[_Union[EnvironmentProblemKind, str]] = ..., message: _Optional[str] = ..., world: _Optional[int] = ...) -> None: ...

class CheckRequest(_message.Message):
    __slots__ = ("seed", "steps")
    SEED_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    seed: int
    steps: int
    def __init__(self, seed: _Optional[int] = ..., steps: _Optional[int] = ...) -> None: ...

class CheckReply(_message.Message):
    __slots__ = ("violations", "checked", "deterministic", "episodes", "steps")
    VIOLATIONS_FIELD_NUMBER: _ClassVar[int]
    CHECKED_FIELD_NUMBER: _ClassVar[int]
    DETERMINISTIC_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    violations: _containers.RepeatedCompositeFieldContainer[Violation]
    checked: _containers.RepeatedScalarFieldContainer[str]
    deterministic: bool
    episodes: int
    steps: int
    def __init__(self, violations: _Optional[_Iterable[_Union[Violation, _Mapping]]] = ..., checked: _Optional[_Iterable[str]] = ..., deterministic: bool = ..., episodes: _Optional[int] = ..., steps: _Optional[int] = ...) -> None: ...

class Violation(_message.Message):
    __slots__ = ("rule", "sentence", "warning")
    RULE_FIELD_NUMBER: _ClassVar[int]
    SENTENCE_FIELD_NUMBER: _ClassVar[int]
    WARNING_FIELD_NUMBER: _ClassVar[int]
    rule: str
    sentence: str
    warning: bool
    def __init__(self, rule: _Optional[str] = ..., sentence: _Optional[str] = ..., warning: bool = ...) -> None: ...
