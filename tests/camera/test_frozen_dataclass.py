"""A class made by `frozen_dataclass` is what `dataclasses.dataclass(frozen=True)` makes of it."""

from __future__ import annotations

import copy
import inspect
import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError, asdict, astuple, dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import pytest

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.pinhole import Intrinsics, Pose

Decorator = Callable[[type], Any]


def classes(frozen: Decorator, unequal: Decorator) -> tuple[Any, ...]:
    @frozen
    class Point:
        """A point."""

        x: float
        y: float = 2.0
        names: list[str] = field(default_factory=list, compare=False)
        length: float = field(init=False)
        count: int = field(default=3, init=False, repr=False)
        memory: dict[int, int] = field(default_factory=dict, init=False, repr=False, compare=False)
        unit: ClassVar[str] = "mm"

        def __post_init__(self) -> None:
            object.__setattr__(self, "length", abs(self.x))

        @cached_property
        def double(self) -> float:
            return 2.0 * self.x

    @frozen
    class Named(Point):
        name: str = field(default="", kw_only=True)

    @frozen
    class Mixed(Named):
        last: int = field(kw_only=True)
        both: tuple[int, ...] = field(default_factory=tuple, kw_only=True)
        y: float = 3.0
        wide: bool = False

    @unequal
    class Identity:
        value: int

        def __repr__(self) -> str:
            return "one"

    return Point, Named, Identity, Mixed


OURS = classes(frozen_dataclass, frozen_dataclass(eq=False))
THEIRS = classes(dataclass(frozen=True), dataclass(frozen=True, eq=False))
PAIRS = list(zip(OURS, THEIRS, strict=True))


@frozen_dataclass
class Kept:
    """Can be found by pickle."""

    a: int
    b: tuple[int, ...] = ()


@pytest.mark.parametrize(("ours", "theirs"), PAIRS)
def test_signature_and_fields_are_those_of_a_dataclass(ours: Any, theirs: Any) -> None:
    assert str(inspect.signature(ours)) == str(inspect.signature(theirs))
    assert str(inspect.signature(ours.__init__)) == str(inspect.signature(theirs.__init__))
    for name in ("__name__", "__qualname__", "__module__", "__annotations__"):
        assert getattr(ours.__init__, name) == getattr(theirs.__init__, name)
    assert ours.__match_args__ == theirs.__match_args__
    assert is_dataclass(ours)
    assert [repr(f) for f in fields(ours)] == [repr(f) for f in fields(theirs)]


@pytest.mark.parametrize(("ours", "theirs"), PAIRS[:2])
def test_objects_are_those_of_a_dataclass(ours: Any, theirs: Any) -> None:
    mine, other = ours(1.0, names=["a"]), theirs(1.0, names=["a"])
    assert vars(mine) == vars(other)
    assert repr(mine) == repr(other)
    assert hash(mine) == hash(other)
    assert asdict(mine) == asdict(other)
    assert astuple(mine) == astuple(other)
    assert vars(replace(mine, x=-5.0)) == vars(replace(other, x=-5.0))
    assert vars(copy.deepcopy(mine)) == vars(mine)
    assert mine.double == other.double == 2.0
    assert ours(1.0).names is not ours(1.0).names


@pytest.mark.parametrize("cls", OURS[:2])
def test_objects_compare_by_their_fields(cls: Any) -> None:
    assert cls(1.0, names=["a"]) == cls(1.0, names=["b"])
    assert hash(cls(1.0, names=["a"])) == hash(cls(1.0, names=["b"]))
    assert cls(1.0) != cls(2.0)
    assert cls(1.0).__eq__(1.0) is NotImplemented


def test_objects_of_two_classes_differ() -> None:
    Point, Named, *_ = OURS
    assert Point(1.0) != Named(1.0)


@pytest.mark.parametrize("identity", [OURS[2], THEIRS[2]])
def test_without_eq_an_object_equals_itself_alone(identity: Any) -> None:
    one = identity(1)
    assert one == one
    assert one != identity(1)
    assert {one: 2}[one] == 2
    assert repr(one) == "one"


@pytest.mark.parametrize("cls", [*OURS[:2], *THEIRS[:2]])
@pytest.mark.parametrize("name", ["x", "anything"])
def test_nothing_is_assigned_or_deleted(cls: Any, name: str) -> None:
    value = cls(1.0)
    with pytest.raises(FrozenInstanceError, match=f"cannot assign to field '{name}'"):
        setattr(value, name, 2.0)
    with pytest.raises(FrozenInstanceError, match=f"cannot delete field '{name}'"):
        delattr(value, name)


@pytest.mark.parametrize("arguments", [(), (1.0, 2.0, [], 4.0), (1.0, 2.0, [], "name")])
def test_wrong_arguments_are_refused_in_the_same_words(arguments: tuple[Any, ...]) -> None:
    with pytest.raises(TypeError) as theirs:
        THEIRS[1](*arguments)
    with pytest.raises(TypeError) as ours:
        OURS[1](*arguments)
    assert str(ours.value) == str(theirs.value)


def test_arguments_are_given_by_position_and_by_name() -> None:
    for arguments, names in [
        ((1.0,), {"last": 2}),
        ((1.0, 5.0, ["a"], True), {"last": 2, "name": "b", "both": (3,)}),
    ]:
        mine, other = OURS[3](*arguments, **names), THEIRS[3](*arguments, **names)
        assert vars(mine) == vars(other)
        assert repr(mine) == repr(other)


def test_what_a_class_defines_itself_stays() -> None:
    @frozen_dataclass
    class Own:
        value: int

        def __init__(self) -> None:
            vars(self)["value"] = 4

        def __eq__(self, other: object) -> bool:
            return True

    assert Own().value == 4
    assert Own() == 5


def test_a_default_stands_behind_the_fields_without_one() -> None:
    with pytest.raises((TypeError, SyntaxError), match="default"):

        @frozen_dataclass
        class Disordered:
            first: int = 1
            second: int


def test_arrays_are_compared_and_hashed_by_their_values() -> None:
    poses = [Pose(np.eye(3), np.array([0.0, 0.0, z])) for z in (1, 1, 2)]
    cameras = [Camera(Intrinsics(1, 1, 0, 0), Distortion("k1", [k])) for k in (0.1, 0.1, 0.2)]
    for first, same, other in (poses, cameras):
        assert first == same
        assert len({first, same, other}) == 2


def test_objects_are_pickled() -> None:
    assert pickle.loads(pickle.dumps(Kept(1, (2, 3)))) == Kept(1, (2, 3))
