"""The HTML pages of a calibration, a rig and a zoom lens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import zip_longest
from operator import itemgetter

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.evaluation import predict
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.calibration.verdict.evidence import evidence_of
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.show.camera_panels import in_plane
from neurocal_cli.commands.show.camera_report import parameter_rows, plane_report, target_lines
from neurocal_cli.commands.show.html_page import (
    Origin,
    board_shape,
    enlargement,
    error_bars,
    figure,
    heat_map,
    page,
    residual_map,
    scatter,
    section,
    table,
    verdict_block,
)
from neurocal_cli.commands.show.plot_pages import edge_coverage, rig_in_space
from neurocal_cli.commands.show.rig_report import camera_rows, pose_rows, side_rows
from neurocal_cli.commands.show.text import with_std
from neurocal_cli.commands.show.zoom_report import lens_words, network_rows
from neurocal_cli.errors import InputError, one_line

_MOST_REJECTED = 200  # rows
_SETTINGS = 25  # samples along a control


Result = Calibration | Rig | ZoomLens
Photographs = Sequence[Mapping[str, bytes]]  # of each camera: the images of its views as JPEG files


def page_of(result: Result, origin: Origin, photographs: Photographs = ()) -> str:
    """Make the page of a result, with the photographs of a camera or of all cameras of a rig, if given."""
    if isinstance(result, Calibration):
        return _calibration_page(result, origin, photographs)
    return _rig_page(result, origin, photographs) if isinstance(result, Rig) else _lens_page(result, origin)


def _calibration_page(calibration: Calibration, origin: Origin, photographs: Photographs) -> str:
    size = calibration.image_size
    head = (
        f"images of {'unknown size' if size is None else f'{size[0]} x {size[1]} px'}, "
        f"{len(calibration.views)} views, {len(calibration.points)} points, distortion model "
        f"{calibration.distortion_model}"
    )
    parts = [
        f'<p class="soft">{escape(head)}</p>',
        verdict_block(calibration.verdict),
        section("Parameters", table(parameter_rows(calibration))),
        _measurements(calibration),
        *_camera_parts(calibration, *photographs),
        _repeat("neurocal calibrate POINTS.csv", calibration, origin),
    ]
    return page(f"Calibration of {one_line(calibration.camera_name)}", parts)


def _rig_page(rig: Rig, origin: Origin, photographs: Photographs) -> str:
    cameras, first = list(rig.cameras), one_line(rig.first)
    head = f"{len(cameras)} cameras connected by {len(rig.frames)} frames, rms {rig.rmse_px:.4g} px"
    frames = [["frame", *(f"{one_line(name)} rms [px]" for name in cameras)]]
    for name, views in rig.frames.items():
        errors = [
            f"{rig.cameras[camera].views[views[camera]].rmse_px:.4f}" if camera in views else ""
            for camera in cameras
        ]
        frames.append([one_line(name), *errors])
    edges = [["cameras", "common frames", "cover of their images", f"distance [{one_line(rig.unit)}]"]]
    (_, covered), place = edge_coverage(rig), {name: k for k, name in enumerate(cameras)}
    for (a, b), count in rig.edges.items():
        pair, i, j = rig.pair(a, b), place[a], place[b]
        distance = with_std(pair.baseline, pair.std["baseline"])
        cover = f"{covered[i, j]:.0%}, {covered[j, i]:.0%}"
        edges.append([f"{one_line(a)} - {one_line(b)}", str(count), cover, distance])
    space = figure(
        rig_in_space(rig),
        f"The cameras and the boards of all frames, seen from above and from the right of {first}.",
    )
    left_out = [["view", "reason"]]
    left_out += [[one_line(f"{a} / {b}"), reason] for (a, b), reason in rig.views_left_out.items()]
    parts = [
        f'<p class="soft">{escape(head)}</p>',
        verdict_block(rig.verdict),
        section(f"The poses of the cameras, relative to {first}", "".join(map(table, pose_rows(rig)))),
        section("The cameras", table(camera_rows(rig)[0]), table(side_rows(rig))),
        section("The rig in space", f'<div class="figures">{space}</div>' if space else ""),
        section("Pairs of cameras", table(edges, sortable=True)),
        section("Frames", table(frames, sortable=True)),
        section("Views left out of the rig", table(left_out)),
        _warnings(rig.warnings),
    ]
    for (name, camera), images in zip_longest(rig.cameras.items(), photographs):
        parts.append(section(f"Camera {one_line(name)}", " "))
        parts += _camera_parts(camera, images)
    command = "stereo LEFT.csv RIGHT.csv" if isinstance(rig, StereoRig) else "rig POINTS.csv..."
    parts.append(_repeat(f"neurocal {command}", rig.cameras[rig.first], origin))
    return page(f"Calibration of {len(cameras)} cameras", parts)


def _lens_page(lens: ZoomLens, origin: Origin) -> str:
    command = f"neurocal lens fit POINTS.csv --seed {lens.seed} -o LENS.yaml"
    head, lines = lens_words(lens)
    parts = [
        f'<p class="soft">{escape(head)}</p>',
        verdict_block(lens.verdict),
        section("Networks", table(network_rows(lens)), _listed(lines)),
        section("Uncertainty over the settings", f'<div class="figures">{_over_settings(lens)}</div>'),
        section("How to repeat it", _origin(command, origin, {})),
    ]
    return page("Calibration of a zoom lens", parts)


def _over_settings(lens: ZoomLens) -> str:
    """Draw a map of the focal length's relative standard deviation over the range of zoom and focus."""
    low, span = lens.low, np.maximum(lens.high - lens.low, 1e-300)
    share = np.linspace(0, 1, _SETTINGS)
    grid = np.stack(np.meshgrid(share, share if len(low) > 1 else [0.0, 1.0]), axis=-1)
    settings = low + span * grid.reshape(-1, 2)[:, : len(low)]
    try:
        prediction = lens.predict(settings)
    except InputError:  # the networks give no valid camera there
        return ""
    percent = 100 * prediction.std[:, 0] / prediction.local[:, 0]
    height = 0.75 if len(low) > 1 else 0.15
    dots = np.column_stack([(lens.settings - low) / span, np.full((len(lens.settings), 1), 0.5)])[:, :2]
    ranges = " and ".join(
        f"{name} from {a:.6g} to {b:.6g} {where}"
        for name, a, b, where in zip(
            lens.controls, low, lens.high, ("from left to right", "from top to bottom"), strict=False
        )
    )
    return figure(
        heat_map(
            percent.reshape(len(grid), -1), (640.0, 640 * height), dots * (640.0, 640 * height), "%",
            "standard deviation of the focal length",
        ),
        f"Standard deviation of alpha_u in per cent, {ranges}. Dots are the calibrated settings.",
    )  # fmt: skip


def _camera_parts(calibration: Calibration, photographs: Mapping[str, bytes] | None = None) -> list[str]:
    """Sections on a camera: drawings, views, rejected points and views, warnings."""
    parts: list[str] = []
    points, pixels = calibration.points, calibration.points.pixels
    if len(points):
        poses = [calibration.views[name].pose for name in points.view_names]
        # 0 for points that cannot be projected.
        residuals = np.nan_to_num(predict(calibration.camera, poses, points)[0] - pixels)
        size = calibration.image_size or tuple((np.ceil(pixels.max(axis=0)) + 1).astype(int).tolist())
        scale = enlargement(residuals, size)
        names = list(calibration.views)
        errors = [view.rmse_px for view in calibration.views.values()]
        drawings = [
            figure(
                residual_map(pixels, residuals, size),
                f"Residuals (projected minus observed) of all points, {scale:.3g} times enlarged. Where "
                "there are no points the camera is extrapolated.",
            ),
            _uncertainty(calibration),
            figure(
                scatter(residuals),
                "Residuals of all points. Noise makes a round cloud, or a cross for mid-points, which are "
                "measured across their edges alone.",
            ),
            figure(
                error_bars(names, errors, calibration.rmse_px),
                "Rms error of each view [px], in their order. The line is that of all points, "
                f"{calibration.rmse_px:.3g} px.",
            ),
        ]
        parts += [
            section("Residuals and uncertainty", f'<div class="figures">{"".join(drawings)}</div>'),
            _models(calibration),
            _board(calibration),
        ]
        parts += _view_parts(calibration, residuals, size, scale, photographs or {})
    return [*parts, _rejected(calibration), _warnings(calibration.warnings)]


def _models(calibration: Calibration) -> str:
    """Section on the lens models that were tried, best first."""
    choice = sorted(calibration.lens_choice.items(), key=itemgetter(1))
    rows = [["distortion model", "cross-validation error [px]", ""]]
    rows += [
        [name, f"{error:.4f}", "chosen" if name == calibration.distortion_model else ""]
        for name, error in choice
    ]
    text = "The simplest of those that predict points that were left out best is chosen."
    return section("Lens models tried", table(rows), f'<p class="soft">{text}</p>' if choice else "")


def _board(calibration: Calibration) -> str:
    """Section on the target as it was found, with a drawing of each of its planes."""
    target, unit = calibration.target, one_line(calibration.unit)
    if target is None:
        return ""
    drawings = []
    for plane in range(int(target.plane.max()) + 1):
        across, offsets = in_plane(target, plane)
        height = offsets[:, 2]
        drawings.append(
            figure(
                board_shape(across, height),
                f"Height of its points, {height.min():.2g} to {height.max():.2g} {unit}. The area of a "
                "disc is the height, and its colour the side.",
            )
        )
    drawn = f'<div class="figures">{"".join(drawings)}</div>'
    return section("The board as it was found", _listed(target_lines(target, unit)), drawn)


def _measurements(calibration: Calibration) -> str:
    """Section on what is measured how well on a plane at the distance of the targets."""
    points = calibration.points
    if not len(points) or calibration.image_size is None or not np.isfinite(calibration.sigma):
        return ""
    poses = [calibration.views[name].pose for name in points.view_names]
    depths = [pose.to_camera(points.world[points.view_index == k])[:, 2] for k, pose in enumerate(poses)]
    distance = float(f"{np.median(np.concatenate(depths)):.3g}")
    if distance <= 0:
        return ""
    text = (
        "On a plane that faces the camera at this distance, which is taken as exact: the length is half of "
        "what the image shows, and the points are relative to the camera. For other distances: neurocal "
        "evaluate camera --at."
    )
    tables = map(table, plane_report(calibration.errors_at(distance), calibration.unit).tables)
    return section("What it means for measurements", *tables, f'<p class="soft">{escape(text)}</p>')


def _uncertainty(calibration: Calibration) -> str:
    """Draw a map of the standard deviation of projected pixels at the points' median distance."""
    evidence = evidence_of(calibration)
    found = None if evidence is None else evidence.projection
    if found is None or calibration.image_size is None:
        return ""
    rows = len(np.unique(found.pixels[:, 1]))
    drawing = heat_map(
        found.std[1].reshape(rows, -1),
        calibration.image_size,
        calibration.points.pixels,
        "px",
        "standard deviation of projected pixels",
    )
    return figure(
        drawing,
        "How uncertain the camera is: standard deviation of a projected pixel, for points at the middle "
        f"distance; {found.worst:.3g} px at most. Dots are the points of all views.",
    )


def _view_parts(
    calibration: Calibration,
    residuals: Array,
    size: tuple[int, int],
    scale: float,
    photographs: Mapping[str, bytes],
) -> list[str]:
    """Sections on the views: a table, and a drawing of each one's residuals with the same enlargement."""
    points = calibration.points
    unit = one_line(calibration.unit)
    rows = [["view", "points", "rms [px]", "max [px]", f"distance [{unit}]", "tilt [deg]"]]
    figures, rejected = [], calibration.rejected.points
    for k, name in enumerate(points.view_names):
        view, own = calibration.views[name], points.view_index == k
        lengths = np.hypot(*residuals[own].T)
        distance = float(np.linalg.norm(view.pose.to_camera(points.world[own].mean(axis=0))))
        tilt = float(np.degrees(np.arccos(np.clip(abs(view.pose.R[2, 2]), 0, 1))))
        rows.append(
            [one_line(name), str(int(own.sum())), f"{view.rmse_px:.4f}", f"{lengths.max():.4f}",
             f"{distance:#.5g}".rstrip("."), f"{tilt:.1f}"]
        )  # fmt: skip
        crosses = None
        if rejected is not None and name in rejected.view_names:
            crosses = rejected.pixels[rejected.view_index == rejected.view_names.index(name)]
        drawing = residual_map(
            points.pixels[own], residuals[own], size, scale, bold=2.2,
            left_out=crosses, photograph=photographs.get(name),
        )  # fmt: skip
        figures.append(figure(drawing, f"{one_line(name)}: {view.rmse_px:.3f} px"))
    return [
        section("Views", table(rows, sortable=True)),
        section(
            "Residuals of each view",
            f'<p class="soft">All {scale:.3g} times enlarged; a click shows one large. Crosses are '
            "points that were left out.</p>",
            f'<div class="views{" wider" if photographs else ""}">{"".join(figures)}</div>',
        ),
    ]


def _rejected(calibration: Calibration) -> str:
    """Section of the views and of the points that were left out."""
    rejected = calibration.rejected
    rows = [["view", "point", "u", "v", "error [px]"]]
    if rejected.points is not None:
        points = rejected.points
        for k in range(min(len(points), _MOST_REJECTED)):
            name = points.view_names[points.view_index[k]]
            label = "" if points.point is None else str(points.point[k])
            u, v = points.pixels[k]
            rows.append(
                [one_line(name), one_line(label), f"{u:.2f}", f"{v:.2f}", f"{rejected.error_px[k]:.2f}"]
            )
    views = [["view", "reason"], *([one_line(name), why] for name, why in rejected.views.items())]
    return section("Left out", table(views), table(rows, sortable=True))


def _warnings(warnings: tuple[str, ...]) -> str:
    return section("Warnings", _listed(warnings))


def _listed(texts: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>" if texts else ""


def _repeat(command: str, calibration: Calibration, origin: Origin) -> str:
    """Section on how to make the file again: `command` with the calibration's options is likely right."""
    options = f" --type {calibration.type}" if calibration.type != 1 else ""
    if calibration.method in ("neuro", "linear", "nonlinear", "tsai"):
        options += f" --method {calibration.method}"
    if calibration.trainer in ("lm", "backprop"):
        options += f" --trainer {calibration.trainer}"
    if calibration.distortion_model != "none" or not calibration.lens_choice:
        options += f" --distortion {calibration.distortion_model}"
    if not calibration.intrinsics.skewed:
        options += " --no-skew"
    likely = f"{command}{options} --seed {calibration.seed}"
    text = (
        "The same points, options and seed give the same file, byte for byte, with the same versions. The "
        "file holds its points; neurocal evaluate camera judges it again."
    )
    facts = {"seed": str(calibration.seed), "how it ended": calibration.stop_reason}
    return section("How to repeat it", _origin(likely, origin, facts), f'<p class="soft">{text}</p>')


def _origin(likely: str, origin: Origin, facts: Mapping[str, str]) -> str:
    """Describe the run, or a command with a similar result if the run is unknown."""
    entries = {"command" if origin.command else "a command with a similar result": origin.command or likely}
    entries |= facts
    if origin.versions:
        entries["versions"] = ", ".join(f"{name} {number}" for name, number in origin.versions.items())
    entries |= {f"SHA-256 of {one_line(name)}": digest for name, digest in origin.files.items()}
    lines = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in entries.items())
    return f"<dl>{lines}</dl>"
