"""Files of zoom lenses: the lens as YAML, and points or known cameras at many settings as CSV.

A lens file has networks and tables, whose numbers read back exactly. Known cameras are rows of parameters, or
of names of calibration files.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli import __version__
from neurocal_cli.adjustment.cross_validation import Quadratics
from neurocal_cli.calibration.zoom.fit import LensCameras
from neurocal_cli.calibration.zoom.mlfn import Topology
from neurocal_cli.calibration.zoom.parameter_networks import SCALES, LensNets, ParameterNet
from neurocal_cli.calibration.zoom.settings import CONTROLS, Constants, LensPoints, Tables, describe
from neurocal_cli.calibration.zoom.zoom_lens import Member, RejectedSetting, ZoomLens
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import MODELS, POLYNOMIAL_MODELS, Distortion, coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.nearest_camera import with_model
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import FormatError, InputError, value_failures
from neurocal_cli.files.calibration_blocks import read_target, target_lines
from neurocal_cli.files.camera_tree import read_tree
from neurocal_cli.files.exchange.reading import read_camera
from neurocal_cli.files.key_tables import Columns, Keys, Kind, check_format, inline, record
from neurocal_cli.files.points_csv import POINTS, correspondences
from neurocal_cli.files.reading import read_bytes
from neurocal_cli.files.table import Table, parse_table
from neurocal_cli.files.table_header import Schema, column_names
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.writing import write_whole
from neurocal_cli.files.yaml_text import block, flow, indented, list_lines, number, text

_FORMAT = 2
_BLOCK = "neurocal_lens"
_CAMERA = ("alpha_u", "alpha_v", "u0", "v0")
_MOST_UNITS = 1000
_HEADER = 10_000  # bytes in which the header is


def format_lens(lens: ZoomLens) -> str:
    """Text of a lens file."""
    return "\n".join([*block(_BLOCK, _lines(lens)), ""])


def write_lens(lens: ZoomLens, path: str | Path) -> None:
    """Write a lens file, whole or not at all; ``-`` is stdout."""
    write_whole(path, format_lens(lens))


def read_lens(path: str | Path) -> ZoomLens:
    """Read a lens file; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read, is another kind of file, or a key is missing or wrong.
    """
    root = read_tree(path)
    if _BLOCK not in root:
        kind = "is a camera" if "camera_matrix" in root else "is not a lens"
        root.refuse(f"{kind}; give a file that `neurocal lens fit` wrote")
    return lens_from_field(root)


def lens_from_field(root: Field) -> ZoomLens:
    """Read a lens from the tree of its file; see `read_lens`."""
    with value_failures(root.source):
        return _lens(root[_BLOCK])


def _lines(lens: ZoomLens) -> Iterator[str]:
    yield f"format: {_FORMAT}"
    yield f"version: {text(__version__)}"
    yield from _HEAD.lines(lens)
    yield from block("settings", _settings(lens.controls).lines(lens, False))
    yield "members:"
    for member in lens.members:
        yield f"  - scale: {member.nets.scale}"
        yield from indented(_CONSTANTS.lines("constants", member.constants, False), 4)
        yield "    networks:"
        for name, net in zip(lens.names, member.nets.nets, strict=True):
            yield from indented(block(name, _NET.lines(net)), 6)
    for name, table in (("tables", lens.tables), ("static", lens.static)):
        yield from block(name, _TABLE.lines(table))
    if lens.target is not None:
        yield from target_lines(lens.target, long=False)
    if lens.target_coupling is not None:
        yield f"target_coupling: {flow(lens.target_coupling.reshape(len(lens.settings), -1))}"


def _positive(field: Field) -> float:
    value = field.number()
    if value <= 0:
        field.fail("a positive number")
    return value


_positive_number = {"positive": inline(_positive, number)}
_CONSTANTS = record(Constants, Keys("theta: number, R: 3x3, t: 2"), inline=True)
_NET = Keys(
    "hidden: units, centre: number, spread: positive, scatter: number, precision: n, weights: n",
    {"units": inline(lambda field: field.array(2), str), **_positive_number},
    hidden=lambda net: [net.topology.own, net.topology.hidden],
)
_TABLE = Keys(
    "constants: constants, local: nxn, H: nxn, g: nxn, cost: n",
    {"constants": _CONSTANTS},
    H=lambda table: table.normal.S[(slice(None), *np.triu_indices(table.normal.S.shape[1]))],
    g=lambda table: table.normal.g,
    cost=lambda table: table.normal.cost,
)
_FIT = Keys(
    "n_points: integer, rmse_px: measure, left_out_px: measure, free_pose_px?: measure, variance: positive",
    _positive_number,
    n_points=lambda lens: lens.counts.sum(),
    rmse_px=lambda lens: np.nan if lens.known else lens.rmse_px,
)
_REJECTED = Keys(
    "setting: setting, reason: quoted",
    {"setting": inline(lambda f: tuple(f.array(-1).tolist()), lambda setting: flow(np.array(setting)))},
)
_HEAD = Keys(
    "controls: names, parameters=names: names, distortion=model: text, camera: text,"
    "skew=free_theta: boolean,"
    "training: text, seed: integer, converged: boolean, unit: text, image_width: integer,"
    "image_height: integer, fit: fit, scatter: n, rejected: rejected, warnings: lines",
    {
        "fit": record(dict, _FIT, inline=True),
        "rejected": Kind(
            lambda field: tuple(RejectedSetting(**_REJECTED.read(entry)) for entry in field.items()),
            lambda key, rejected, _: list_lines(key, map(_REJECTED.flow, rejected)),
        ),
    },
    camera=lambda lens: "known" if lens.known else "still" if lens.still else "moving",
    image_width=lambda lens: (lens.image_size or (0, 0))[0],
    image_height=lambda lens: (lens.image_size or (0, 0))[1],
    fit=lambda lens: lens,
)


def _lens(block: Field) -> ZoomLens:
    check_format(block, _FORMAT)
    head = _HEAD.read(block)
    controls, names, model = (head[key] for key in ("controls", "names", "model"))
    if not controls or any(name not in CONTROLS for name in controls) or len(set(controls)) < len(controls):
        block["controls"].fail("zoom, focus or both")
    camera, fit = head.pop("camera"), head.pop("fit")
    if camera not in ("known", "still", "moving"):
        block["camera"].fail("known, still or moving")
    _check_names(block, camera, names, model)
    table = _settings(controls).read(block["settings"])
    if table is None or not (np.ptp(table["settings"], axis=0) > 0).all():
        block["settings"]["rows"].fail("several rows of finite settings")
    settings = table.pop("settings").reshape(-1, len(controls))
    L, S = len(names), len(settings)
    block["scatter"].array(L)
    for field in block["rejected"].items():
        field["setting"].array(len(controls))
    members = tuple(_member(field, names, len(controls)) for field in block["members"].items())
    if not members:
        block["members"].fail("a list of at least one lens")
    size = head.pop("image_width"), head.pop("image_height")
    Q = {"known": 0, "still": 6, "moving": 1}[camera]
    coupling = block.read("target_coupling", lambda field: field.array(S, -1))
    if coupling is not None and coupling.shape[1] % (L + Q):
        block["target_coupling"].fail(f"rows of a multiple of {L + Q} numbers")
    return ZoomLens(
        **head,
        settings=settings,
        still=camera == "still",
        known=camera == "known",
        members=members,
        tables=_table(block["tables"], S, L, Q),
        static=_table(block["static"], S, L, Q),
        variance=fit["variance"],
        **table,
        left_out_px=fit["left_out_px"],
        free_pose_px=np.nan if fit["free_pose_px"] is None else fit["free_pose_px"],
        image_size=size if all(size) else None,
        target=block.read("target", read_target),
        target_coupling=None if coupling is None else coupling.reshape(S, L + Q, -1),
    )


def _check_names(block: Field, camera: str, names: tuple[str, ...], model: str) -> None:
    """Check the distortion model and the names of the local parameters."""
    with value_failures(block.source, f"{block.path}.distortion: "):
        coefficients = coefficient_names(model)
    t_z = ("t_z",) if camera == "still" or (camera == "known" and "t_z" in names) else ()
    expected = (*_CAMERA, *t_z, *coefficients)
    if names != expected:
        block["parameters"].fail(f"the list {', '.join(expected)}")


def _settings(controls: Sequence[str]) -> Columns:
    return Columns(f"settings={' '.join(controls)}: number, counts=n_points: integer, rmse=rmse_px: measure")


def _member(field: Field, names: tuple[str, ...], D: int) -> Member:
    scale = field["scale"].text()
    if scale not in SCALES:
        field["scale"].fail(f"one of {', '.join(SCALES)}")
    nets = []
    for field_of_net in (field["networks"][name] for name in names):
        net = _NET.read(field_of_net)
        hidden = net.pop("hidden")
        if not ((hidden >= 0) & (hidden <= _MOST_UNITS) & (hidden == np.floor(hidden))).all():
            field_of_net["hidden"].fail("two numbers of units")
        topology = Topology(D, int(hidden[0]), int(hidden[1]))
        if len(net["weights"]) == (older := replace(topology, rich=False)).n_weights:
            topology = older
        field_of_net["weights"].array(topology.n_weights)
        field_of_net["precision"].array(topology.n_groups)
        nets.append(ParameterNet(topology, **net))
    return Member(LensNets(scale, tuple(nets)), _CONSTANTS.read(field["constants"]))


def _table(field: Field, S: int, L: int, Q: int) -> Tables:
    size = L + Q
    upper = np.triu_indices(size)
    found = _TABLE.read(field)
    for key, shape in {"H": (S, len(upper[0])), "g": (S, size), "cost": (S,), "local": (S, L)}.items():
        field[key].array(*shape)
    H = np.zeros((S, size, size))
    H[:, upper[0], upper[1]] = found["H"]
    H[:, upper[1], upper[0]] = found["H"]
    return Tables(found["local"], found["constants"], Quadratics(H, found["g"], found["cost"]))


_FILES = "camera"
_CAMERAS = Schema(kind="cameras", required=_CAMERA, optional=("t_z", *CONTROLS))
_LIST = Schema(kind="cameras", required=(_FILES,), optional=("t_z", *CONTROLS), labels=frozenset({_FILES}))
_ORDINARY = (*POLYNOMIAL_MODELS, "rational")  # the simplest first


def read_lens_data(
    paths: str | Path | Sequence[str | Path], *, notes: list[str] | None = None
) -> LensPoints | LensCameras:
    """Read points at many settings, or known cameras, depending on the header.

    Parameters
    ----------
    paths : str, Path or a sequence of them
        ``-`` is stdin.
    notes : list of str, optional
        Remarks about ignored columns are appended.

    Raises
    ------
    FormatError, InputError
        An unreadable file, a missing setting, or inconsistent data.
    """
    several = [paths] if isinstance(paths, (str, bytes, os.PathLike)) else list(paths)
    if not several:
        raise InputError("there are no files; give at least one")
    contents = [read_bytes(path) for path in several]
    headers = [column_names(data[:_HEADER].decode("utf-8", "replace"), POINTS) for data, _ in contents]
    known = all("alpha_u" in names or (_FILES in names and "X" not in names) for names in headers)
    schemas = [POINTS if not known else _CAMERAS if "alpha_u" in names else _LIST for names in headers]
    tables = [parse_table(*content, schema) for content, schema in zip(contents, schemas, strict=True)]
    remarks = notes if notes is not None else []
    return _cameras(tables, remarks) if known else _points(tables, remarks)


def read_lens_points(
    paths: str | Path | Sequence[str | Path], *, notes: list[str] | None = None
) -> LensPoints:
    """Read points at many settings; see `read_lens_data`.

    Raises
    ------
    FormatError
        A file is malformed, or has known cameras instead of points.
    """
    data = read_lens_data(paths, notes=notes)
    if not isinstance(data, LensPoints):
        raise FormatError("has known cameras, not points; give columns X,Y,Z,u,v", data.source)
    return data


def _points(tables: list[Table], notes: list[str]) -> LensPoints:
    controls = _controls(tables)
    values = [np.column_stack([table.numbers[name] for name in controls]) for table in tables]
    plain = []
    for table, setting in zip(tables, values, strict=True):
        numbers = {name: column for name, column in table.numbers.items() if name not in controls}
        labels = table.labels | {"view": _images(table, controls, setting, len(tables) > 1)}
        plain.append(replace(table, numbers=numbers, labels=labels))
    points = correspondences(plain, notes)
    columns = np.vstack(values)
    return LensPoints.grouped(points, {name: columns[:, k] for k, name in enumerate(controls)})


def _images(table: Table, controls: tuple[str, ...], setting: Array, several: bool) -> NDArray[Any]:
    """View names: the file's labels, with the settings added if a label occurs at several settings."""
    distinct, index = np.unique(setting, axis=0, return_inverse=True)
    index = index.ravel()
    texts = np.array([describe(controls, row) for row in distinct])[index]
    own = table.labels.get("view")
    if own is None:
        return np.char.add(f"{Path(table.source).stem} ", texts) if several else texts
    views = own.tolist()
    if len(set(zip(views, index.tolist(), strict=True))) == len(set(views)):
        return own
    return np.char.add(np.char.add(own, " "), texts)


def _cameras(tables: list[Table], notes: list[str]) -> LensCameras:
    for table in tables:
        table.note_unknown(notes)
    _controls(tables)
    cameras = [camera for table in tables for camera in _in_rows(table)]
    sizes = {one.image_size for one in cameras} | {table.metadata.image_size for table in tables}
    if len(sizes := sizes - {None}) > 1:
        raise InputError(f"{tables[0].source}: the cameras differ in image_size; give cameras of one lens")
    model, coefficients = _common_model([camera.distortion for camera in cameras], tables[0].source)
    shared = [name for name in ("t_z", *CONTROLS) if all(name in table.numbers for table in tables)]
    columns = {name: np.concatenate([table.numbers[name] for table in tables]) for name in shared}
    for name in (*_CAMERA, "theta"):
        columns[name] = np.array([getattr(camera.intrinsics, name) for camera in cameras])
    theta = float(np.median(columns.pop("theta")))
    return LensCameras.of(
        columns | dict(zip(MODELS[model], coefficients.T, strict=True)),
        next(iter(sizes), None),
        tables[0].metadata.unit or "mm",
        tables[0].source,
        model,
        theta,
    )


def _in_rows(table: Table) -> list[Camera]:
    """The cameras of a table: of the files that it names, relative to its folder, or of their parameters."""
    if _FILES in table.labels:
        return [read_camera(Path(table.source).parent / name) for name in table.labels[_FILES].tolist()]
    values = table.stack(_CAMERA)
    positive = (values[:, :2] > 0).all(axis=1)
    if not positive.all():
        line = int(table.lines[np.argmin(positive)])
        problem = "alpha_u and alpha_v must be positive; correct or remove the row"
        raise FormatError(problem, table.source, line)
    size = table.metadata.image_size
    return [Camera(Intrinsics(*row), Distortion(), size) for row in values.tolist()]


def _common_model(lenses: Sequence[Distortion], source: str) -> tuple[str, Array]:
    """The simplest distortion model that includes those of all cameras, and its coefficients (S, K)."""
    for model in (*_ORDINARY, "fisheye"):
        found = [alike for lens in lenses if (alike := with_model(lens, model)) is not None]
        if len(found) == len(lenses):
            return model, np.array([lens.coefficients for lens in found])
    models = {lens.model for lens in lenses}
    if "fisheye" in models:
        raise InputError(f"{source}: some cameras are fisheyes and some are not; give cameras of one lens")
    raise InputError(
        f"{source}: a zoom lens cannot have the distortion model {min(models - set(_ORDINARY))}; convert the "
        "cameras with neurocal convert --model rational, or fisheye"
    )


def _controls(tables: Sequence[Table]) -> tuple[str, ...]:
    """Names of the controls, at least one, which all files must share."""
    names = [set(table.numbers) & set(CONTROLS) for table in tables]
    for found, table in zip(names, tables, strict=True):
        if not found:
            raise FormatError(
                "there is no column zoom or focus; name the setting of each row in one or both", table.source
            )
        if found != names[0]:
            raise FormatError(
                f"must have the same columns of zoom and focus as {tables[0].source}; add or remove one",
                table.source,
            )
    return tuple(name for name in CONTROLS if name in names[0])
