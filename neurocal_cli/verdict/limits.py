"""Limits of the quantities that a verdict rests on."""

from __future__ import annotations

from neurocal_cli.frozen_dataclass import frozen_dataclass


@frozen_dataclass
class Limit:
    """From where on a quantity is no longer good, and from where on it is poor."""

    good: float
    poor: float

    def grade(self, value: float) -> int:
        """0 good, 1 usable, 2 poor; what is unknown is good."""
        return int(value > self.good) + int(value > self.poor)
