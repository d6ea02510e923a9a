"""Read corners of boards measured by other programs.

* A dictionary (FileStorage, JSON, ``.npz``, ``.mat``) with image points of each view and board points;
* a single ``.npy`` array of image points;
* mrcal's ``corners.vnl``: a line for each corner, ``filename x y [level]``, row by row;
* text files of numbers: one with the board points, and one for each view;
* tables of points, and ``calib_data.mat`` of Bouguet's toolbox.

If the files have no board points, the board must be given. MATLAB counts pixels from 1, and corners along the
columns of the board. Kalibr has no file of corners: it detects them in a bag in each run.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.exchange.camera_names import NAMES
from neurocal_cli.files.exchange.corner_tables import (
    Given,
    Seen,
    assembled,
    has_points,
    is_of_cells,
    of_cells,
    separate,
    table_of,
    vnl,
)
from neurocal_cli.files.exchange.document import KALIBR_REPORT, PACKED, Document, camera_matrix
from neurocal_cli.files.exchange.loose_keys import LooseKeys
from neurocal_cli.files.exchange.mat_file import MARK, read_variables
from neurocal_cli.files.exchange.matlab import FIRST_PIXEL, STRUCTS, unit_of
from neurocal_cli.files.tree_fields import Field, plain
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.points import Correspondences

# Names of what a dictionary has, and what has a view that stands apart.
KEYS = {
    "pixels": "image_points imgpoints img_points corners all_corners",
    "places": "object_points objpoints obj_points grid_points world_points",
    "views": "observations views images frames",
    "pixels of a view": "location_in_image_space points",
    "places of a view": "location_in_object_space points",
    "name of a view": "name image image_name file filename snapshot_name",
}
_PIXELS = {plain(name) for name in KEYS["pixels"].split()}
BOARD_ADVICE = "give --board chessboard:COLSxROWS:SQUARE"
_HEAD = 1_000_000  # characters that show of what kind a file is
_VNL = re.compile(r"\A(?:##[^\n]*\n)*#\s*filename\s+x\s+y\b")
_NUMBERS = re.compile(r"\A(?:[-+0-9.eE]+[ \t,;]+){1,2}[-+0-9.eE]+\s*\n")


def read_corners(
    paths: Sequence[str | Path],
    board: Board | None,
    notes: list[str],
    unit: str | None = None,
    what: str | None = None,
    advice: str = "give --cols, --rows and --square, or --board",
) -> Correspondences | None:
    """Read points from files of any program; None if the first file has no points.

    The files are one, or board points and then a file for each view; stdin counts only within a command.
    `board` gives the board points, and `unit` theirs, if the files do not; without them the error ends in
    `advice`. Remarks about ignored columns are appended to `notes`. A file with a camera as well is left to
    it, unless `what` is "points".
    """
    names = [str(path) for path in paths]
    document = Document(names[0])
    source, text = document.source, document.text
    given = Given(board, unit, what == "points", advice, notes)
    if document.data.startswith(MARK):
        return _matlab(document, given)
    if document.data.startswith(PACKED):
        return _corners(document.root, given)
    if document.array is not None and camera_matrix(document.array) is not None:
        return None
    if not document.is_text:
        found = document.array if len(names) == 1 else None
        return None if found is None else _corners(Field({"corners": found.tolist()}, source), given)
    if re.match(KALIBR_REPORT[0], text):
        raise FormatError(KALIBR_REPORT[1], source)
    if _VNL.match(text):
        return vnl(text, source, given)
    if _NUMBERS.match(text):
        return separate(names, given)
    if board is not None and is_of_cells(text):
        return of_cells(names, board, notes)
    if has_points(text):
        return table_of(names, given)
    named = {plain(name) for name in re.findall(r"^(\w+)\s*:", text, re.MULTILINE)}
    if not named.isdisjoint(_PIXELS) or text.lstrip().startswith(("{", "<", "%YAML", "/", "[{", "[\n")):
        return _corners(document.root, given)
    return None


def _corners(root: Field, given: Given, first: float = 0.0, down: bool = False) -> Correspondences | None:
    """Read the points of a dictionary, if it has any; `first` is the coordinate of its first pixel.

    Without board points, `down` tells that the corners run along the columns of the board.
    """
    field = root.called(KEYS["pixels"])
    stacked = field is not None and (not isinstance(field.value, dict) or "data" in field)
    apart = [] if stacked else _views_apart(root)
    if not stacked and not apart:
        return None
    if isinstance(root.value, dict) and not given.points and LooseKeys(root).has_camera():
        given.notes.append(f"{root.source}: holds points as well as a camera; --what points converts these")
        return None
    unit, ids = root["unit"].text() if "unit" in root else None, None
    if stacked:
        assert field is not None
        pixels = _stack(field, 2) - first
        names = [f"{k:0{len(str(len(pixels)))}d}" for k in range(1, len(pixels) + 1)]
        if "view_names" in root:
            names = root["view_names"].names(len(pixels))
        stated = root.called(KEYS["places"])
        world: list[Array | None] = [None] * len(pixels) if stated is None else list(_stack(stated, 3))
        if len(world) not in (1, len(pixels)):
            field.fail(f"one list of points on the board, or {len(pixels)}")
        world = world if len(world) > 1 else world * len(pixels)
        ids = root.read("points", lambda field: field.names(pixels.shape[1]))
        views = [Seen(*one, field) for one in zip(names, pixels, world, strict=True)]
    else:
        views = [_seen(*one) for one in apart]
        if unit is None and given.unit is None and "locationInObjectSpace" in str(root.value)[:_HEAD]:
            unit = "m"
    points = assembled(views, given, root.source, ids, unit=unit, named=stacked, down=down)
    return replace(points, image_size=_size(root, points.pixels))


def _size(root: Field, pixels: Array) -> tuple[int, int] | None:
    """Size of the images; a shape is height and width, or with pixels beyond it width and height."""
    size = LooseKeys(root).image_size() if isinstance(root.value, dict) else None
    shape = isinstance(root.value, dict) and any(plain(key) in NAMES["image_shape"] for key in root.value)
    if size is not None and shape and (pixels > size).any() and (pixels <= size[::-1]).all():
        return size[::-1]
    return size


def _views_apart(root: Field) -> list[tuple[str, Field, Field | None]]:
    """Name, pixels and board points of each view, where a file has the views apart; none for others."""
    if (images := root.called(KEYS["pixels"])) is not None:  # a mapping of pixels by the names of the views
        places = root.called(KEYS["places"])
        return [(name, entry, places) for name, entry in images.entries().items()]
    value = root.value
    for key in KEYS["views"].split():
        if isinstance(value, dict) and isinstance(value.get(key), (list, dict)):
            root, value = root[key], value[key]
    parts = root.entries().items() if isinstance(value, dict) else enumerate(root.items())
    found = []
    for name, part in parts if isinstance(value, (list, dict)) else ():
        pixels, places = (
            part.called(f"{KEYS[what]} {KEYS[f'{what} of a view']}") for what in ("pixels", "places")
        )
        if pixels is None:
            return []
        stated = part.called(KEYS["name of a view"])
        found.append((str(name) if stated is None else stated.text(), pixels, places))
    return found


def _seen(name: str, measured: Field, places: Field | None) -> Seen:
    """The corners of a view that stands apart."""
    pixels = _listed(measured, "uv", "xy")
    pixels = np.where((pixels == -1).all(axis=1, keepdims=True), np.nan, pixels)  # PhotonVision has no corner
    return Seen(name, pixels, None if places is None else _listed(places, "XYZ", "xyz"), measured)


def _listed(entry: Field, *axes: str) -> Array:
    """Points of one view, in lists of any depth or in mappings of x and y, or u and v."""
    for names in axes:
        first = entry.value[0] if isinstance(entry.value, list) and entry.value else None
        if isinstance(first, dict) and set(names) <= set(first):
            return np.array([[one[axis].number() for axis in names] for one in entry.items()])
    return _stack(entry, len(axes[0]))[0]


def _stack(field: Field, width: int) -> Array:
    """Points of each view, (V, N, width); board points may lack Z."""
    value = field.value
    if isinstance(value, dict):  # an OpenCV matrix, of one channel or several
        data = field["data"].array(-1, unknown=True)
        rows, cols = field["rows"].integer(1), field["cols"].integer(1)
        if len(data) % (rows * cols):
            field.fail(f"{rows} x {cols} points")
        value = data.reshape(rows, cols, -1)
    if isinstance(value, list) and value and isinstance(value[0], dict):  # a matrix for each view
        return np.concatenate([_stack(entry, width) for entry in field.items()])
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        field.fail("the same number of points in each view, as numbers")
    if array.ndim == 1 and array.size % width == 0:  # OpenCV writes vectors of points flat
        array = array.reshape(1, -1, width)
    if array.ndim == 2 and array.shape[1] > 3 and array.shape[1] % width == 0:  # and vectors of these
        array = array.reshape(len(array), -1, width)
    if array.ndim == 4:  # (V, N, 1, 2), as OpenCV's functions return them, or (V, 1, N, 2)
        array = array.reshape(len(array), -1, array.shape[-1])
    if array.ndim == 3 and array.shape[1] == 1 and array.shape[-1] in (2, 3) and array.shape[0] > 1:
        array = array.reshape(1, -1, array.shape[-1])  # (N, 1, 2): one view
    if array.ndim == 2:
        array = array[None]
    if width == 3 and array.ndim == 3 and array.shape[-1] == 2:
        array = np.concatenate([array, np.zeros((*array.shape[:2], 1))], axis=2)
    if array.ndim != 3 or array.shape[-1] != width or array.size == 0:
        field.fail(f"points of {width} coordinates")
    return array


def _matlab(document: Document, given: Given) -> Correspondences | None:
    source, tree = document.source, read_variables(document.data, document.source)
    if not given.points and ("fc" in tree or not {*STRUCTS, "K"}.isdisjoint(tree)):
        return None
    field = next((name for name in tree if plain(name) in _PIXELS), None)
    if field is None:
        return _bouguet(tree, source, given)
    values = {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in tree.items()
    }
    root = Field(values, source)
    if np.size(tree.get("ImageSize", ())) == 2:  # MATLAB's is height and width
        root.value["image_size"] = [int(side) for side in np.ravel(root.value.pop("ImageSize"))[::-1]]
    root.value.setdefault("unit", unit_of(tree))
    stack = np.asarray(tree[field], dtype=float)
    if stack.ndim == 4:  # M x 2 x P x cameras
        raise FormatError(
            f"{field} are those of two cameras; save {field}(:,:,:,1) and {field}(:,:,:,2) apart", source
        )
    if stack.ndim == 3:  # M x 2 x P
        root.value[field] = np.moveaxis(stack, 2, 0).tolist()
    given = replace(given, board=given.board or _matlab_board(tree, given.unit, source))
    return _corners(root, given, FIRST_PIXEL, down=True)


def _bouguet(tree: dict[str, Any], source: str, given: Given) -> Correspondences | None:
    """Points of Bouguet's toolbox: x_1, X_1, ... of the active images, in pixels from 0."""
    numbers = [int(name[2:]) for name in tree if re.fullmatch(r"x_\d{1,4}", name) and f"X_{name[2:]}" in tree]
    active = np.ravel(tree.get("active_images", np.ones(max(numbers, default=0))))
    views = []
    for k in sorted(numbers):
        x, X = (np.asarray(tree[f"{name}_{k}"], dtype=float) for name in "xX")
        if x.ndim != 2 or x.shape[0] != 2 or X.shape != (3, x.shape[1]) or not np.isfinite(x).all():
            continue  # NaN where the image was left out
        if k <= len(active) and active[k - 1]:
            views.append(Seen(str(k), x.T, X.T, Field(None, source)))
    if not views:
        return None
    size = tuple(int(np.ravel(tree[name])[0]) for name in ("nx", "ny") if np.size(tree.get(name, ())) == 1)
    points = assembled(views, given, source, named=False)
    return replace(points, image_size=(size[0], size[1]) if len(size) == 2 else None)


def _matlab_board(tree: dict[str, Any], unit: str | None, source: str) -> Board | None:
    """Read the board from variables of MATLAB's examples: [rows, columns] of squares, and their side."""
    size = next((tree[name] for name in ("boardSize", "patternDims") if name in tree), None)
    side = next((tree[name] for name in ("squareSize", "squareSizeInMM") if name in tree), None)
    if size is None or side is None:
        return None
    try:
        rows, cols = (int(count) - 1 for count in np.ravel(size))
        plane = Plane("", cols, rows, float(np.ravel(side)[0]))
    except (InputError, ValueError, TypeError, OverflowError, IndexError) as error:
        raise FormatError(
            "boardSize and squareSize are not those of a board; give --cols, --rows and --square", source
        ) from error
    return Board((plane,), "mm" if "squareSizeInMM" in tree else unit or "unknown")
