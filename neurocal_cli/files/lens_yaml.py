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
from neurocal_cli.files.calibration_blocks import read_target, target_lines
from neurocal_cli.files.failures import value_failures
from neurocal_cli.files.text_columns import table_lines
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.writing import write_whole
from neurocal_cli.files.yaml_text import (
    block,
    boolean,
    flow,
    list_lines,
    mapping,
    number,
    quoted,
    read_yaml,
    text,
    words,
)

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
    yield from _record_lines(lens)
    columns = dict(zip(lens.controls, lens.settings.T, strict=True))
    columns |= {"n_points": lens.counts, "rmse_px": lens.rmse}
    yield from block("settings", table_lines(columns, long=False, indent=2))
    yield "members:"
    for member in lens.members:
        yield f"  - scale: {member.nets.scale}"
        yield f"    constants: {_constants(member.constants)}"
        yield "    networks:"
        for name, net in zip(lens.names, member.nets.nets, strict=True):
            yield f"      {name}:"
            yield f"        hidden: [{net.topology.own}, {net.topology.hidden}]"
            for key in ("centre", "spread", "scatter"):
                yield f"        {key}: {number(getattr(net, key))}"
            yield f"        precision: {flow(net.precision)}"
            yield f"        weights: {flow(net.weights)}"
    for name, table in (("tables", lens.tables), ("static", lens.static)):
        yield f"{name}:"
        yield f"  constants: {_constants(table.constants)}"
        yield f"  local: {flow(table.local)}"
        upper = np.triu_indices(table.normal.H.shape[1])
        yield f"  H: {flow(table.normal.H[:, upper[0], upper[1]])}"
        yield f"  g: {flow(table.normal.g)}"
        yield f"  cost: {flow(table.normal.cost)}"
    yield from target_lines(lens.target, long=False)
    if lens.target_coupling is not None:
        yield f"target_coupling: {flow(lens.target_coupling.reshape(len(lens.settings), -1))}"


def _record_lines(lens: ZoomLens) -> Iterator[str]:
    width, height = lens.image_size or (0, 0)
    yield f"format: {_FORMAT}"
    yield f"version: {text(__version__)}"
    yield f"controls: {words(lens.controls)}"
    yield f"parameters: {words(lens.names)}"
    yield f"distortion: {text(lens.model)}"
    yield f"camera: {'known' if lens.known else 'still' if lens.still else 'moving'}"
    yield f"skew: {boolean(lens.free_theta)}"
    yield f"training: {text(lens.training)}"
    yield f"seed: {lens.seed}"
    yield f"converged: {boolean(lens.converged)}"
    yield f"unit: {text(lens.unit)}"
    yield f"image_width: {width}"
    yield f"image_height: {height}"
    yield "fit: " + mapping(
        n_points=str(int(lens.counts.sum())),
        rmse_px=number(lens.rmse_px if not lens.known else np.nan),
        left_out_px=number(lens.left_out_px),
        free_pose_px=number(lens.free_pose_px),
        variance=number(lens.variance),
    )
    yield f"scatter: {flow(lens.scatter)}"
    rejected = [
        mapping(setting=flow(np.array(bad.setting)), reason=quoted(bad.reason)) for bad in lens.rejected
    ]
    yield from list_lines("rejected", rejected)
    yield from list_lines("warnings", map(quoted, lens.warnings))


def _constants(constants: Constants) -> str:
    return mapping(theta=number(constants.theta), R=flow(constants.R), t=flow(constants.t))


def _lens(block: Field) -> ZoomLens:
    if block["format"].integer() != _FORMAT:
        block.refuse(
            f"{block.path}.format is not {_FORMAT}: another version of neurocal wrote it; fit the lens again"
        )
    controls = tuple(block["controls"].texts())
    if not controls or any(name not in CONTROLS for name in controls) or len(set(controls)) < len(controls):
        block["controls"].fail("zoom, focus or both")
    camera = block["camera"].text()
    if camera not in ("known", "still", "moving"):
        block["camera"].fail("known, still or moving")
    names, model = _parameter_names(block, camera)
    settings, counts, rmse = _settings(block["settings"], len(controls))
    L, S = len(names), len(settings)
    members = tuple(_member(field, names, len(controls)) for field in block["members"].items())
    if not members:
        block["members"].fail("a list of at least one lens")
    width, height = block["image_width"].integer(), block["image_height"].integer()
    fit = block["fit"]
    Q = {"known": 0, "still": 6, "moving": 1}[camera]
    coupling = block.read("target_coupling", lambda field: field.array(S, -1))
    if coupling is not None and coupling.shape[1] % (L + Q):
        block["target_coupling"].fail(f"rows of a multiple of {L + Q} numbers")
    return ZoomLens(
        controls=controls,
        settings=settings,
        names=names,
        model=model,
        still=camera == "still",
        known=camera == "known",
        members=members,
        tables=_table(block["tables"], S, L, Q),
        static=_table(block["static"], S, L, Q),
        variance=_positive(fit["variance"]),
        scatter=block["scatter"].array(L),
        free_theta=block["skew"].boolean(),
        counts=counts,
        rmse=rmse,
        rejected=tuple(
            RejectedSetting(tuple(bad["setting"].array(len(controls)).tolist()), bad["reason"].text())
            for bad in block["rejected"].items()
        ),
        left_out_px=fit["left_out_px"].number_or_nan(),
        free_pose_px=fit.get("free_pose_px").number_or_nan(),
        training=block["training"].text(),
        seed=block["seed"].integer(),
        converged=block["converged"].boolean(),
        image_size=(width, height) if width and height else None,
        unit=block["unit"].text(),
        warnings=tuple(block["warnings"].texts()),
        target=block.read("target", read_target),
        target_coupling=None if coupling is None else coupling.reshape(S, L + Q, -1),
    )


def _positive(field: Field) -> float:
    value = field.number()
    if value <= 0:
        field.fail("a positive number")
    return value


def _parameter_names(block: Field, camera: str) -> tuple[tuple[str, ...], str]:
    """Read and check the names of the local parameters; returns the distortion model, too."""
    model = block["distortion"].text()
    with value_failures(block.source, f"{block.path}.distortion: "):
        coefficients = coefficient_names(model)
    names = tuple(block["parameters"].texts())
    t_z = ("t_z",) if camera == "still" or (camera == "known" and "t_z" in names) else ()
    expected = (*_CAMERA, *t_z, *coefficients)
    if names != expected:
        block["parameters"].fail(f"the list {', '.join(expected)}")
    return names, model


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
    for net in (field["networks"][name] for name in names):
        hidden = net["hidden"].array(2)
        if not ((hidden >= 0) & (hidden <= _MOST_UNITS) & (hidden == np.floor(hidden))).all():
            net["hidden"].fail("two numbers of units")
        topology = Topology(D, int(hidden[0]), int(hidden[1]))
        parameters = ParameterNet(
            topology,
            net["weights"].array(topology.n_weights),
            net["precision"].array(topology.n_groups),
            net["centre"].number(),
            _positive(net["spread"]),
            net["scatter"].number(),
        )
        nets.append(parameters)
    return Member(LensNets(scale, tuple(nets)), _read_constants(field["constants"]))


def _read_constants(field: Field) -> Constants:
    return Constants(field["theta"].number(), field["R"].array(3, 3), field["t"].array(2))


def _table(field: Field, S: int, L: int, Q: int) -> Tables:
    size = L + Q
    upper = np.triu_indices(size)
    flat = field["H"].array(S, len(upper[0]))
    H = np.zeros((S, size, size))
    H[:, upper[0], upper[1]] = flat
    H[:, upper[1], upper[0]] = flat
    normal = Normal(H, field["g"].array(S, size), field["cost"].array(S), True)
    return Tables(field["local"].array(S, L), _read_constants(field["constants"]), normal)
