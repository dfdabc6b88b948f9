from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Health(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    HEALTH_OK: _ClassVar[Health]
    HEALTH_DEGRADED: _ClassVar[Health]
    HEALTH_FAULT: _ClassVar[Health]

class Method(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    METHOD_UNKNOWN: _ClassVar[Method]
    METHOD_DEPTH: _ClassVar[Method]
    METHOD_POSE: _ClassVar[Method]
    METHOD_FUSED: _ClassVar[Method]
    METHOD_SIMULATED: _ClassVar[Method]

class Visibility(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    OBSERVED: _ClassVar[Visibility]
    PREDICTED: _ClassVar[Visibility]
    OCCLUDED: _ClassVar[Visibility]
HEALTH_OK: Health
HEALTH_DEGRADED: Health
HEALTH_FAULT: Health
METHOD_UNKNOWN: Method
METHOD_DEPTH: Method
METHOD_POSE: Method
METHOD_FUSED: Method
METHOD_SIMULATED: Method
OBSERVED: Visibility
PREDICTED: Visibility
OCCLUDED: Visibility

class Capsule(_message.Message):
    __slots__ = ("label", "p0", "p1", "radius", "v0", "v1", "position_bound", "velocity_bound", "visibility")
    LABEL_FIELD_NUMBER: _ClassVar[int]
    P0_FIELD_NUMBER: _ClassVar[int]
    P1_FIELD_NUMBER: _ClassVar[int]
    RADIUS_FIELD_NUMBER: _ClassVar[int]
    V0_FIELD_NUMBER: _ClassVar[int]
    V1_FIELD_NUMBER: _ClassVar[int]
    POSITION_BOUND_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_BOUND_FIELD_NUMBER: _ClassVar[int]
    VISIBILITY_FIELD_NUMBER: _ClassVar[int]
    label: str
    p0: _containers.RepeatedScalarFieldContainer[float]
    p1: _containers.RepeatedScalarFieldContainer[float]
    radius: float
    v0: _containers.RepeatedScalarFieldContainer[float]
    v1: _containers.RepeatedScalarFieldContainer[float]
    position_bound: float
    velocity_bound: float
    visibility: Visibility
    def __init__(self, label: _Optional[str] = ..., p0: _Optional[_Iterable[float]] = ..., p1: _Optional[_Iterable[float]] = ..., radius: _Optional[float] = ..., v0: _Optional[_Iterable[float]] = ..., v1: _Optional[_Iterable[float]] = ..., position_bound: _Optional[float] = ..., velocity_bound: _Optional[float] = ..., visibility: _Optional[_Union[Visibility, str]] = ...) -> None: ...

class Body(_message.Message):
    __slots__ = ("id", "capsules")
    ID_FIELD_NUMBER: _ClassVar[int]
    CAPSULES_FIELD_NUMBER: _ClassVar[int]
    id: int
    capsules: _containers.RepeatedCompositeFieldContainer[Capsule]
    def __init__(self, id: _Optional[int] = ..., capsules: _Optional[_Iterable[_Union[Capsule, _Mapping]]] = ...) -> None: ...

class HumanState(_message.Message):
    __slots__ = ("schema_version", "sensor_id", "session_uuid", "seq", "clock_id", "t_capture_ns", "t_capture_sigma_ns", "t_publish_ns", "frame_id", "calibration_hash", "method", "safety_rated", "health", "health_bits", "coverage", "blind_margin_m", "detection_capability_m", "bodies", "empty_certified")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    SESSION_UUID_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    CLOCK_ID_FIELD_NUMBER: _ClassVar[int]
    T_CAPTURE_NS_FIELD_NUMBER: _ClassVar[int]
    T_CAPTURE_SIGMA_NS_FIELD_NUMBER: _ClassVar[int]
    T_PUBLISH_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_HASH_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    SAFETY_RATED_FIELD_NUMBER: _ClassVar[int]
    HEALTH_FIELD_NUMBER: _ClassVar[int]
    HEALTH_BITS_FIELD_NUMBER: _ClassVar[int]
    COVERAGE_FIELD_NUMBER: _ClassVar[int]
    BLIND_MARGIN_M_FIELD_NUMBER: _ClassVar[int]
    DETECTION_CAPABILITY_M_FIELD_NUMBER: _ClassVar[int]
    BODIES_FIELD_NUMBER: _ClassVar[int]
    EMPTY_CERTIFIED_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    sensor_id: int
    session_uuid: str
    seq: int
    clock_id: str
    t_capture_ns: int
    t_capture_sigma_ns: int
    t_publish_ns: int
    frame_id: str
    calibration_hash: bytes
    method: Method
    safety_rated: bool
    health: Health
    health_bits: int
    coverage: float
    blind_margin_m: float
    detection_capability_m: float
    bodies: _containers.RepeatedCompositeFieldContainer[Body]
    empty_certified: bool
    def __init__(self, schema_version: _Optional[int] = ..., sensor_id: _Optional[int] = ..., session_uuid: _Optional[str] = ..., seq: _Optional[int] = ..., clock_id: _Optional[str] = ..., t_capture_ns: _Optional[int] = ..., t_capture_sigma_ns: _Optional[int] = ..., t_publish_ns: _Optional[int] = ..., frame_id: _Optional[str] = ..., calibration_hash: _Optional[bytes] = ..., method: _Optional[_Union[Method, str]] = ..., safety_rated: _Optional[bool] = ..., health: _Optional[_Union[Health, str]] = ..., health_bits: _Optional[int] = ..., coverage: _Optional[float] = ..., blind_margin_m: _Optional[float] = ..., detection_capability_m: _Optional[float] = ..., bodies: _Optional[_Iterable[_Union[Body, _Mapping]]] = ..., empty_certified: _Optional[bool] = ...) -> None: ...
