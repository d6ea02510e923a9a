"""What is measured how well on a plane or in space, and where a camera was, as rows of tables and as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neurocal_cli.camera.measured import CameraPosition, PlaneErrors, Spread
from neurocal_cli.commands.show.text import Table, printable, rounded, with_std


def plane_tables(errors: PlaneErrors | None, unit: str) -> list[Table]:
    """Rows, the heading first: a length and two points, with the shares of calibration and pixels."""
    if errors is None:
        return []
    unit = printable(unit)
    rows = [[f"at {errors.distance:g} {unit}", f"std [{unit}]", "of calibration", "of pixels"]]
    for what, spread in (
        (f"a length of {errors.length:.4g} {unit}", errors.of_length),
        ("a point in the middle", errors.of_middle),
        ("its depth", errors.of_depth),
        ("the least certain point", errors.of_worst),
    ):
        if spread is None:
            continue
        told = spread.std, spread.by_calibration, spread.by_pixel
        rows.append([what, *(rounded(std, std)[0] for std in told)])
    return [rows]


def plane_json(errors: PlaneErrors | None) -> dict[str, Any]:
    """The same as an entry of JSON; none without errors."""
    if errors is None:
        return {}

    def shares(spread: Spread) -> dict[str, float]:
        return {"std": spread.std, "calibration": spread.by_calibration, "pixels": spread.by_pixel}

    at = {
        "distance": errors.distance,
        "sigma_px": errors.sigma,
        "length": {"length": errors.length, **shares(errors.of_length)},
        "middle": shares(errors.of_middle),
        **({} if errors.of_depth is None else {"depth": shares(errors.of_depth)}),
        "worst": shares(errors.of_worst),
    }
    return {"at": at}


def position_tables(positions: Mapping[str, CameraPosition], unit: str) -> list[Table]:
    """Rows, the heading first: where the camera was in each view; no table without views."""
    rows = [["camera in", *(f"{axis} [{printable(unit)}]" for axis in "XYZ")]]
    for name, place in positions.items():
        pairs = zip(place.point.tolist(), place.std.tolist(), strict=True)
        cells = [with_std(value, std) if std > 0 else f"{value:.7g}" for value, std in pairs]
        rows.append([printable(name), *cells])
    return [rows] if positions else []


def positions_json(positions: Mapping[str, CameraPosition]) -> dict[str, Any]:
    """The same as values for JSON, with covariances."""
    return {
        name: {
            "point": place.point,
            "std": place.std,
            "covariance": place.covariance,
        }
        for name, place in positions.items()
    }
