"""A drift from one calibration of a camera to another, as tables, lines, JSON and a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.drift import SHARE, Drift
from neurocal_cli.calibration.rig.rig_drift import RigDrift
from neurocal_cli.calibration.verdict.findings import two_digits
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.show.figure import ACCENT, colour_bar, drawing, plain, style
from neurocal_cli.commands.show.text import (
    UNITS,
    Report,
    Table,
    attributes,
    labelled,
    parameters,
    rounded,
    with_std,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from neurocal_cli.camera.camera import Camera

_COLUMNS, _ROWS = ("left", "middle", "right"), ("top", "middle", "bottom")
_CHANGES = ("scale", "centre_u", "centre_v")
_SURELY = 1e-12  # smaller shares are rounding errors of the tail
_ROUND = 0.1  # larger shares are shown in whole percents
_LEVELS = 12
_STRONG = 3.0  # standard deviations, a line in the picture
_ARROWS = 11  # across
_LONGEST = 0.06  # of the image's width, the longest arrow


def drift_report(old: Calibration | Camera, new: Calibration | Camera, drift: Drift) -> Report:
    """The judgement, and the numbers behind it: the parameters and the differences over the image."""
    u, v = drift.pixels[drift.worst]
    scale, *centre = zip(drift.changes.tolist(), drift.changes_std.tolist(), strict=True)
    moves = [with_std(value, std) for value, std in centre]
    lines = [
        f"{'different' if drift.different else 'the same within chance'}: {_in_pixels(drift)}",
        f"  most clearly at ({u:.0f}, {v:.0f}): {two_digits(drift.length[drift.worst])} px, std "
        f"{two_digits(drift.std[drift.worst])} px",
        f"  scale: {with_std(100 * scale[0], 100 * scale[1])} %",
        f"  image centre: {moves[0]} px in u, {moves[1]} px in v",
        f"  chance: {_chance(drift.share)} of the calibrations of an unchanged camera differ as much; the "
        f"limit is {100 * SHARE:g} %",
    ]
    rows = zip(drift.pixels, drift.difference, drift.std, strict=True)
    tree = {
        **drift_json(drift),
        "parameters": {
            name: {"old": a, "new": b, "std": std} for name, (a, b, std) in _compared(old, new).items()
        },
        "image": [{"u": u, "v": v, "du": du, "dv": dv, "std_px": std} for (u, v), (du, dv), std in rows],
    }
    tables = [table for table in (_parameter_table(old, new), _image_table(drift)) if len(table) > 1]
    return Report(tree, tables, lines)


def rig_drift_report(drift: RigDrift) -> Report:
    """The judgement on a rig: the differences of the cameras, and those of their poses, with the chances."""
    images = [["camera", "difference rms [px]", "std [px]", "chance"]]
    for name, camera in drift.cameras.items():
        images.append([name, two_digits(camera.rms_px), two_digits(camera.rms_std), _chance(camera.share)])
    unit = f" [{drift.unit}]"
    poses = [["pose", "turn [mrad]", "std", f"shift{unit}", "std", f"baseline{unit}", "chance"]]
    for name, pose in drift.poses.items():
        sizes = (1000 * pose.turn, 1000 * pose.turn_std, pose.shift, pose.shift_std)
        cells = [two_digits(float(np.linalg.norm(one))) for one in sizes]
        poses.append([name, *cells, with_std(pose.baseline, pose.baseline_std), _chance(pose.share)])
    told = [f"{name} has changed" for name in drift.changed]
    told += [f"{name} has moved relative to {drift.reference}" for name in drift.moved]
    lines = [
        f"{'different' if told else 'the same within chance'}{': ' if told else ''}{', '.join(told)}",
        f"  a chance below {100 * drift.limit:.2g} % is a change; so unchanged rigs are called different in "
        f"at most {100 * SHARE:g} % of the cases",
    ]
    of_cameras = {
        name: drift_json(one) | {"different": name in drift.changed, "limit": drift.limit}
        for name, one in drift.cameras.items()
    }
    of_poses = {
        name: {
            "different": name in drift.moved,
            "share": one.share,
            "turn_rad": {"value": one.turn.tolist(), "std": one.turn_std.tolist()},
            "shift": {"value": one.shift.tolist(), "std": one.shift_std.tolist()},
            "baseline": {"value": one.baseline, "std": one.baseline_std},
        }
        for name, one in drift.poses.items()
    }
    tree = attributes(drift, "different limit reference") | {"cameras": of_cameras, "poses": of_poses}
    return Report(tree, [images, poses], lines)


def since_report(drift: Drift | None) -> Report:
    """What new points say of an old calibration."""
    if drift is None:
        unknown = "these points alone do not determine the camera, so they do not tell whether it has changed"
        return Report(below=[unknown])
    word = "no longer holds" if drift.different else "still holds"
    line = (
        f"the calibration {word}: calibrated from these points, the camera differs by {_in_pixels(drift)}; "
        f"{_chance(drift.share)} of unchanged cameras differ as much"
    )
    return Report({"drift": drift_json(drift)}, below=[line])


def _in_pixels(drift: Drift) -> str:
    return f"{two_digits(drift.rms_px)} px rms over the image, std {two_digits(drift.rms_std)} px"


def _chance(share: float) -> str:
    if share < _SURELY:
        return f"less than {100 * _SURELY:g} %"
    return f"{format(100 * share, '.0f' if share > _ROUND else '.1g')} %"


def drift_json(drift: Drift) -> dict[str, Any]:
    """The judgement and the numbers behind it."""
    u, v = drift.pixels[drift.worst]
    at = {"u": u, "v": v, "px": drift.length[drift.worst], "std_px": drift.std[drift.worst]}
    changes = zip(_CHANGES, drift.changes, drift.changes_std, strict=True)
    return {
        **attributes(drift, "different share"),
        "limit": SHARE,
        **attributes(drift, "rms_px expected_px=rms_std"),
        "changes": {name: {"value": value, "std": std} for name, value, std in changes},
        "worst": at,
    }


def _compared(old: Calibration | Camera, new: Calibration | Camera) -> dict[str, tuple[float, float, float]]:
    """Old value, new value and std of the difference of the parameters that two calibrations have."""
    if not (isinstance(old, Calibration) and isinstance(new, Calibration)):
        return {}
    before, after = parameters(old), parameters(new)
    stds = [camera.std_of_given | dict(camera.std) for camera in (old, new)]
    return {
        name: (before[name], after[name], math.hypot(*(std.get(name, math.nan) for std in stds)))
        for name in before
        if name in after and not name.startswith("d_")
    }


def _parameter_table(old: Calibration | Camera, new: Calibration | Camera) -> Table:
    rows = [["parameter", "old", "new", "difference", "std", "in std"]]
    for name, (a, b, std) in _compared(old, new).items():
        if a == b and not std > 0:
            continue
        difference, stated = rounded(b - a, std)
        values = [rounded(x, std)[0] for x in (a, b)]
        ratio = f"{(b - a) / std:+.1f}" if std > 0 else "-"
        rows.append([labelled(name, UNITS.get(name, "")), *values, difference, stated, ratio])
    return rows


def _image_table(drift: Drift) -> Table:
    """Differences in nine places of the image."""
    rows = [["difference [px]", *_COLUMNS]]
    low, high = drift.pixels.min(axis=0), drift.pixels.max(axis=0)
    for k, name in enumerate(_ROWS):
        cells = []
        for j in range(3):
            place = low + (high - low) * np.array([j, k]) / 2
            nearest = int(np.argmin(((drift.pixels - place) ** 2).sum(axis=1)))
            cells.append(with_std(drift.length[nearest], drift.std[nearest]))
        rows.append([name, *cells])
    return rows


def draw_drift(
    drifts: Mapping[str, tuple[Drift, tuple[int, int]]], limit: float = SHARE, kind: str = "png"
) -> bytes:
    """Draw the differences over the images, in pixels and in standard deviations.

    The cameras have names, and the sizes of their images; a single one may have the name "".
    """
    with drawing((5.2 * len(drifts), 7.6), 0.1, kind) as (figure, file):
        panels = figure.subplots(2, len(drifts), squeeze=False)
        for pair, (name, (drift, size)) in zip(panels.T, drifts.items(), strict=True):
            head = f"{plain(name)}\n" if name else ""
            _draw_pixels(pair[0], head, drift, size)
            _draw_ratios(pair[1], head, drift, limit)
            for axes in pair:
                axes.grid(False)
                axes.set(xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5), aspect="equal")
                axes.set(xlabel="u [px]", ylabel="v [px]")
    return file.getvalue()


def _draw_pixels(axes: Axes, head: str, drift: Drift, size: tuple[int, int]) -> None:
    """Draw the differences in pixels, and their directions as arrows."""
    _map(axes, drift, drift.length, "px")
    enlarged = _LONGEST * size[0] / float(drift.length.max(initial=1e-300))
    u, v = np.unique(drift.pixels[:, 0]), np.unique(drift.pixels[:, 1])
    step = max(1, round(len(u) / _ARROWS))
    some = np.isin(drift.pixels[:, 0], u[::step]) & np.isin(drift.pixels[:, 1], v[::step])
    axes.quiver(
        *drift.pixels[some].T, *drift.difference[some].T,
        color="white", angles="xy", scale_units="xy", scale=1 / enlarged, width=0.005,
    )  # fmt: skip
    style(axes, f"{head}New minus old pixel of a ray, {enlarged:,.2g} times enlarged")


def _draw_ratios(axes: Axes, head: str, drift: Drift, limit: float) -> None:
    """Draw the differences in standard deviations, and where they are strong and largest."""
    ratio = drift.length / np.maximum(drift.std, 1e-300)
    _map(axes, drift, ratio, "standard deviations")
    axes.tricontour(drift.pixels[:, 0], drift.pixels[:, 1], ratio, levels=[_STRONG], colors=ACCENT)
    axes.plot(*drift.pixels[drift.worst], "o", color=ACCENT, fillstyle="none", markersize=10)
    word = "different" if drift.share < limit else "the same"
    style(axes, f"{head}In std of both: {word} (line: {_STRONG:g}, circle: most)")


def _map(axes: Axes, drift: Drift, values: Array, unit: str) -> None:
    """Draw values over the image, with a colour bar."""
    levels = np.linspace(0.0, max(float(values.max()), 1e-12), _LEVELS)
    u, v = drift.pixels.T
    shown = axes.tricontourf(u, v, values, levels=levels, cmap="viridis")
    colour_bar(axes, shown, unit, format="%.2g")
