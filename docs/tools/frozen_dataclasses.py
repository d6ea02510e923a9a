"""An extension of griffe: the Python reference shows frozen dataclasses as it shows dataclasses."""

from __future__ import annotations

from typing import Any

from griffe import Class, ExprName, Extension


class FrozenDataclasses(Extension):
    """Takes ``frozen_dataclass`` for the decorator of the standard library, so that signatures are found."""

    def on_class_instance(self, *, cls: Class, **_: Any) -> None:
        for decorator in cls.decorators:
            if decorator.callable_path == "neurocal_cli.camera.frozen_dataclass.frozen_dataclass":
                decorator.value = ExprName("dataclass", parent="dataclasses")
                cls.labels.add("dataclass")
