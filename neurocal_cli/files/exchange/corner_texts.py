"""Write points for other programs: all views of one target as an array, or mrcal's table."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.files.camera_tree import storage_text
from neurocal_cli.files.exchange.dictionary import json_text, npz_bytes
from neurocal_cli.files.exchange.mat_file import saved
from neurocal_cli.files.exchange.matlab import FIRST_PIXEL
from neurocal_cli.files.points_csv import format_points
from neurocal_cli.files.yaml_text import number
from neurocal_cli.observations.points import Correspondences

_REGULAR = 1e-3  # share of a square's side by which sides may differ


def corner_text(points: Correspondences, target: str, ending: str) -> str | bytes:
    """Write points for ``neurocal, opencv, matlab, json, npz`` or ``mrcal``; an `ending` is ".xml"."""
    if target == "neurocal":
        return format_points(points)
    if target not in _TEXTS:
        raise InputError(
            f"{target} has no file of points; convert to one of neurocal, {', '.join(_TEXTS)}, or detect the "
            "board with it"
        )
    return _TEXTS[target](points, ending)


def points_lost(points: Correspondences, target: str) -> tuple[list[str], list[str]]:
    """Losses of the points' accuracy, for warnings, and data that are not in the file, for notes."""
    if target == "neurocal":
        return [], []
    lost = []
    if points.across is not None:
        lost.append(
            "mid-points are measured in one direction only, and other programs take both for measured; "
            "detect --points vertices for them"
        )
    elif points.covariance is not None:
        lost.append("the covariances of the points are not in the file")
    mrcal = target == "mrcal"
    left_out = {
        "X,Y,Z": mrcal,
        "the unit": mrcal,
        "the image size": mrcal and points.image_size is not None,
        "the image centre": points.image_center is not None,
        "the ids of the points": target == "matlab" and points.point is not None,
        "sX,sY,sZ": points.world_std is not None,
        "the distances": bool(points.distances),
    }
    names = [name for name, lacks in left_out.items() if lacks]
    return lost, [f"a file of points of {target} has no place for {', '.join(names)}"] if names else []


def _array(points: Correspondences) -> tuple[Array, list[str], Array]:
    """World points (N, 3), their ids, and the pixels of each view (V, N, 2), NaN where missing."""
    if points.point is not None:
        labels = [str(label) for label in points.point]
    else:
        labels = [" ".join(f"{x:.9g}" for x in row) for row in points.world]
    ids = list(dict.fromkeys(labels))
    place = {label: k for k, label in enumerate(ids)}
    column = np.array([place[label] for label in labels])
    world = np.full((len(ids), 3), np.nan)
    world[column] = points.world
    if np.abs(world[column] - points.world).max() > 0:
        raise InputError("one point is at different places of the world in different views; give one target")
    pixels = np.full((points.n_views, len(ids), 2), np.nan)
    pixels[points.view_index, column] = points.pixels
    if points.point is None:
        ids = [str(k) for k in range(len(ids))]
    return world, ids, pixels


def _tree(points: Correspondences) -> dict[str, Any]:
    world, ids, pixels = _array(points)
    tree: dict[str, Any] = {}
    if points.image_size is not None:
        tree["image_width"], tree["image_height"] = points.image_size
    tree |= {"unit": points.unit, "view_names": list(points.view_names), "points": ids}
    return tree | {"object_points": world, "image_points": pixels}


def _opencv(points: Correspondences, ending: str) -> str:
    tree = _tree(points)
    missing = np.isnan(tree["image_points"]).any(axis=(0, 2))
    if missing.any():
        raise InputError(
            f"{int(missing.sum())} of {len(missing)} points are not in all views, and OpenCV's matrices have "
            "no gaps; convert to npz or json"
        )
    tree["object_points"] = tree["object_points"][:, None]
    return storage_text(tree, ending)


def _matlab(points: Correspondences, ending: str) -> bytes:
    world, _, pixels = _array(points)
    flat = not world[:, 2].any()
    size = points.image_size or (0, 0)
    return saved(
        {
            "imagePoints": np.moveaxis(pixels, 0, 2) + FIRST_PIXEL,
            "worldPoints": world[:, :2] if flat else world,
            "ImageSize": np.array([[float(size[1]), float(size[0])]]),
            "WorldUnits": points.unit,
            "view_names": np.array(points.view_names, dtype=object),
        }
    )


def _mrcal(points: Correspondences, ending: str) -> str:
    """Write a line for each vertex of the board, row by row; ``-`` if it was not found."""
    world, ids, pixels = _array(points)
    try:
        grid = np.array([[int(part) for part in label.split(":")] for label in ids])
        cols, rows = (grid.max(axis=0) + 1).tolist()
    except ValueError:
        grid = np.column_stack([np.unique(x, return_inverse=True)[1].ravel() for x in world[:, :2].T])
        cols, rows = (grid.max(axis=0) + 1).tolist()
        steps = np.concatenate([np.diff(np.unique(x)) for x in world[:, :2].T])
        regular = np.ptp(steps) < _REGULAR * steps.max() if len(steps) else False
        if world[:, 2].any() or cols * rows != len(world) or not regular:
            raise InputError(
                "mrcal takes the vertices of one flat board, and some points are others; detect --points "
                "vertices"
            ) from None
    place = {(c, r): k for k, (c, r) in enumerate(grid.tolist())}
    lines = ["# filename x y level"]
    order = [place.get((c, r)) for r in range(rows) for c in range(cols)]
    for name, view in zip(points.view_names, pixels, strict=True):
        for k in order:
            seen = k is not None and np.isfinite(view[k]).all()
            shown = f"{number(view[k][0])} {number(view[k][1])} 0" if seen else "- - -"
            lines.append(f"{'_'.join(name.split())} {shown}")
    return "\n".join([*lines, ""])


_TEXTS: dict[str, Callable[[Correspondences, str], str | bytes]] = {
    "opencv": _opencv,
    "matlab": _matlab,
    "mrcal": _mrcal,
    "json": lambda points, _: json_text(_tree(points)),
    "npz": lambda points, _: npz_bytes(_tree(points)),
}
