"""Lens files: a zoom lens as YAML, with its networks and tables; numbers read back exactly."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurocal_cli import __version__
from neurocal_cli.calibration.zoom.mlfn import Topology
from neurocal_cli.calibration.zoom.parameter_networks import SCALES, LensNets, ParameterNet
from neurocal_cli.calibration.zoom.settings import CONTROLS, Constants, Normal, Tables
from neurocal_cli.calibration.zoom.zoom_lens import Member, RejectedSetting, ZoomLens
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import value_failures
from neurocal_cli.files.calibration_blocks import read_target, target_lines
from neurocal_cli.files.key_tables import Keys, Kind, inline, record, table_lines
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.writing import write_whole
from neurocal_cli.files.yaml_text import block, flow, indented, list_lines, number, quoted, read_yaml, text

_FORMAT = 2
_BLOCK = "neurocal_lens"
_CAMERA = ("alpha_u", "alpha_v", "u0", "v0")
_MOST_UNITS = 1000


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
    root = read_yaml(path)
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
    columns = dict(zip(lens.controls, lens.settings.T, strict=True))
    columns |= {"n_points": lens.counts, "rmse_px": lens.rmse}
    yield from block("settings", table_lines(columns, long=False, indent=2))
    yield "members:"
    for member in lens.members:
        yield f"  - scale: {member.nets.scale}"
        yield from indented(_CONSTANTS.lines("constants", member.constants, False), 4)
        yield "    networks:"
        for name, net in zip(lens.names, member.nets.nets, strict=True):
            yield from indented(block(name, _NET.lines(net)), 6)
    for name, table in (("tables", lens.tables), ("static", lens.static)):
        yield from block(name, _TABLE.lines(table))
    yield from target_lines(lens.target, long=False)
    if lens.target_coupling is not None:
        yield f"target_coupling: {flow(lens.target_coupling.reshape(len(lens.settings), -1))}"


def _positive(field: Field) -> float:
    value = field.number()
    if value <= 0:
        field.fail("a positive number")
    return value


def _upper(H: Array) -> Array:
    rows, cols = np.triu_indices(H.shape[1])
    return H[:, rows, cols]


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
    H=lambda table: _upper(table.normal.H),
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
    {
        "setting": inline(lambda f: tuple(f.array(-1).tolist()), lambda setting: flow(np.array(setting))),
        "quoted": inline(Field.text, quoted),
    },
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
    if block["format"].integer() != _FORMAT:
        block.refuse(
            f"{block.path}.format is not {_FORMAT}: another version of neurocal wrote it; fit the lens again"
        )
    head = _HEAD.read(block)
    controls, names, model = (head[key] for key in ("controls", "names", "model"))
    if not controls or any(name not in CONTROLS for name in controls) or len(set(controls)) < len(controls):
        block["controls"].fail("zoom, focus or both")
    camera, fit = head.pop("camera"), head.pop("fit")
    if camera not in ("known", "still", "moving"):
        block["camera"].fail("known, still or moving")
    _check_names(block, camera, names, model)
    settings, counts, rmse = _settings(block["settings"], len(controls))
    L, S = len(names), len(settings)
    if head["scatter"].shape != (L,):
        block["scatter"].fail(f"{L} finite numbers")
    for bad, field in zip(head["rejected"], block["rejected"].items(), strict=True):
        if len(bad.setting) != len(controls):
            field["setting"].fail(f"{len(controls)} finite numbers")
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
        counts=counts,
        rmse=rmse,
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


def _settings(field: Field, D: int) -> tuple[Array, NDArray[np.int64], Array]:
    table = field["rows"].array(-1, D + 2, unknown=True)
    settings, counts = table[:, :D], table[:, D]
    if not np.isfinite(table[:, : D + 1]).all() or len(table) < 2 or not (np.ptp(settings, axis=0) > 0).all():
        field["rows"].fail("several rows of finite settings")
    return np.ascontiguousarray(settings), counts.astype(np.int64), np.ascontiguousarray(table[:, D + 1])


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
        for key, count in (("weights", topology.n_weights), ("precision", topology.n_groups)):
            if len(net[key]) != count:
                field_of_net[key].fail(f"{count} finite numbers")
        nets.append(ParameterNet(topology, **net))
    return Member(LensNets(scale, tuple(nets)), _CONSTANTS.read(field["constants"]))


def _table(field: Field, S: int, L: int, Q: int) -> Tables:
    size = L + Q
    upper = np.triu_indices(size)
    found = _TABLE.read(field)
    for key, shape in {"H": (S, len(upper[0])), "g": (S, size), "cost": (S,), "local": (S, L)}.items():
        if found[key].shape != shape:
            field[key].fail(f"{' x '.join(map(str, shape))} finite numbers")
    H = np.zeros((S, size, size))
    H[:, upper[0], upper[1]] = found["H"]
    H[:, upper[1], upper[0]] = found["H"]
    return Tables(found["local"], found["constants"], Normal(H, found["g"], found["cost"], True))
