"""What is measured how well on a plane, as rows of a table and as JSON."""

from __future__ import annotations

from typing import Any

from neurocal_cli.calibration.verdict.findings import two_digits
from neurocal_cli.camera.plane_points import PlaneErrors, Spread
from neurocal_cli.commands.show.text import Table, printable


def plane_table(errors: PlaneErrors, unit: str) -> Table:
    """Rows, the heading first: a length and two points, with the shares of calibration and pixels."""
    unit = printable(unit)
    rows = [[f"at {errors.distance:g} {unit}", f"std [{unit}]", "of calibration", "of pixels"]]
    for what, spread in (
        (f"a length of {errors.length:.4g} {unit}", errors.of_length),
        ("a point in the middle", errors.of_middle),
        ("the least certain point", errors.of_worst),
    ):
        rows.append([what, *map(two_digits, (spread.std, spread.by_calibration, spread.by_pixel))])
    return rows


def plane_json(errors: PlaneErrors) -> dict[str, Any]:
    """The same as values for JSON."""

    def shares(spread: Spread) -> dict[str, float]:
        return {"std": spread.std, "calibration": spread.by_calibration, "pixels": spread.by_pixel}

    return {
        "distance": errors.distance,
        "sigma_px": errors.sigma,
        "length": {"length": errors.length, **shares(errors.of_length)},
        "middle": shares(errors.of_middle),
        "worst": shares(errors.of_worst),
    }
