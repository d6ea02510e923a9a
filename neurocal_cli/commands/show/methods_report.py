"""Comparisons of methods and results of simulations, as tables with titles, JSON and pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.commands.show.figure import ACCENT, drawing, style
from neurocal_cli.commands.show.text import (
    UNITS,
    Report,
    Table,
    attributes,
    number,
    parameters,
    parameters_json,
    with_std,
)
from neurocal_cli.errors import plural
from neurocal_cli.simulation.comparison import Compared, Comparison, MethodErrors, NoiseStudy
from neurocal_cli.simulation.rigs import RigStudy
from neurocal_cli.simulation.scenes import SimulatedScene
from neurocal_cli.simulation.starts import RateStudy, StartStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIG_1 = ("alpha_v", "alpha_u", "t_z", "t_x")
# The errors in the paper's Table 1, calibrated minus true.
_PRINTED = {
    "t_x": 0.02, "t_y": 0.0, "t_z": 0.0, "R_x": 0.0, "R_y": -0.000027, "R_z": -0.00001,
    "alpha_u": 0.001165, "alpha_v": 0.000605, "u0": -0.017553, "v0": -0.001267, "theta": 0.0,
}  # fmt: skip
# Kinds of random starts, in tables and in the picture.
_STARTS = {
    "lm": ("network, trained by lm", "network\nby lm"),
    "backprop": ("network, trained by backprop", "network\nby backprop"),
    "weights": ("plain LM on (3) from the network's random weights", "plain LM,\nrandom\nweights"),
    "camera": ("plain LM on (3) from a random camera", "plain LM,\nrandom\ncamera"),
}
# Colours that colour-blind people can distinguish (Okabe and Ito), markers and their sizes.
_LOOK = {
    "neuro": ("#d55e00", "o", 8.0),
    "backprop": ("#cc79a7", "v", 6.5),
    "nonlinear": ("#0072b2", "x", 7.0),
    "linear": ("#009e73", "s", 5.0),
    "tsai": ("#e69f00", "^", 5.5),
    "opencv": ("#56b4e9", "+", 8.0),
}
_digits = partial(number, form=".4g")
_OWN = 0.9  # a method whose bound is below this share of the largest one has its own line


def _titled(tree: Mapping[str, Any], tables: Sequence[tuple[str, Table]], below: Sequence[str]) -> Report:
    """A report of tables with titles."""
    titles, rows = zip(*tables, strict=True)
    return Report(tree, rows, below, titles=titles)


def comparison_report(comparison: Comparison) -> Report:
    """Tables of errors and of parameters for each camera, of triangulated points for two; best methods."""
    tables, below = [], []
    tree: dict[str, Any] = {
        "n_points": [len(points) for points in comparison.points],
        "cameras": [
            {method: _camera_json(one) for method, one in camera.items()} for camera in comparison.cameras
        ],
    }
    for side, points, camera in zip(("left", "right"), comparison.points, comparison.cameras, strict=False):
        two = len(comparison.cameras) == 2
        title, line = (f"{side} camera, ", f"{side} camera: ") if two else ("", "")
        tables.append(
            (f"{title}{plural(len(points), 'point')} in {plural(points.n_views, 'view')}", _errors(camera))
        )
        known = {method: one.calibration for method, one in camera.items() if one.calibration is not None}
        names = dict.fromkeys(
            [*INTRINSIC_NAMES, *(name for one in known.values() for name in parameters(one))]
        )
        rows = [[name, *(_estimate(one, name) for one in known.values())] for name in names]
        tables.append((f"{title}parameters", [["parameter", *known], *rows]))
        errors = {method: one.held_out_px for method, one in camera.items()}
        below += _lowest(f"{line}lowest held-out error", errors, " px")
        below += [f"{line}{method}: {one.problem}" for method, one in camera.items() if one.problem]
    if comparison.stereo is not None:
        tree["unit"] = unit = comparison.unit
        tree["stereo"] = {
            method: {
                **attributes(one.by_view, "rmse nsce"),
                "baseline": one.baseline,
                "rig": None if one.rig is None else attributes(one.rig, "rmse nsce"),
            }
            for method, one in comparison.stereo.items()
        }
        head = ["method", f"RMSE [{unit}]", "NSCE", f"baseline [{unit}]"]
        head += [f"through one rig: RMSE [{unit}]", "NSCE"]
        rows = [head]
        for method, pair in comparison.stereo.items():
            rig = ["-", "-"] if pair.rig is None else [_digits(pair.rig.rmse), _digits(pair.rig.nsce)]
            alone = _digits(pair.by_view.rmse), _digits(pair.by_view.nsce), f"{pair.baseline:.2f}"
            rows.append([method, *alone, *rig])
        tables.append(("both cameras, each calibrated alone", rows))
        found = {method: pair.by_view for method, pair in comparison.stereo.items()}
        below += _lowest("lowest RMSE", {method: one.rmse for method, one in found.items()}, f" {unit}")
        below += _lowest("lowest NSCE", {method: one.nsce for method, one in found.items()}, "")
    return _titled(tree, tables, below)


def _errors(camera: dict[str, Compared]) -> Table:
    rows = [["method", "rms [px]", "held-out [px]", "time [ms]", "distortion"]]
    for method, one in camera.items():
        cells = ["-"] * 4
        if one.calibration is not None:
            model = one.calibration.distortion_model
            errors = _digits(one.calibration.rmse_px), _digits(one.held_out_px)
            cells = [*errors, f"{1000 * one.seconds:.0f}", "no distortion" if model == "none" else model]
        rows.append([method, *cells])
    return rows


def _estimate(calibration: Calibration, name: str) -> str:
    values = parameters(calibration)
    if name not in values:
        return "-"
    if name in calibration.fixed:
        return f"{values[name]:.6g} given"
    return with_std(values[name], calibration.std[name])


def _lowest(what: str, errors: dict[str, float], unit: str) -> list[str]:
    """A line about the best method, with all methods that have the same digits in the table."""
    known = {method: error for method, error in errors.items() if math.isfinite(error)}
    if not known:
        return []
    best = min(known.values())
    winners = [method for method, error in known.items() if _digits(error) == _digits(best)]
    names = " and ".join([", ".join(winners[:-1]), winners[-1]] if len(winners) > 1 else winners)
    return [f"{what}: {names}, {_digits(best)}{unit}"]


def _camera_json(one: Compared) -> dict[str, Any]:
    calibration = one.calibration
    if calibration is None:
        return {"problem": one.problem}
    return {
        "rmse_px": calibration.rmse_px,
        **attributes(one, "held_out_px seconds"),
        "distortion_model": calibration.distortion_model,
        "parameters": parameters_json(calibration),
    }


def simulation_report(
    scene: SimulatedScene, seed: int, study: NoiseStudy, starts: StartStudy | None, paper: bool
) -> Report:
    """The studies of noise and starts; of the scene of the `paper`, its printed errors are shown, too."""
    tree = {
        "n_points": len(scene.world),
        "n_views": len(scene.poses),
        "seed": seed,
        **attributes(study, "trials sigma parameters=names"),
        "truth": _by_name(study, study.truth),
        "methods": {
            name: {
                "error_without_noise": _by_name(study, one.exact),
                "rms": _by_name(study, one.rms.T),
                "bias": _by_name(study, one.bias.T),
                "bound_for_1_px": _by_name(study, one.bound),
                "failed": one.failed,
            }
            for name, one in study.methods.items()
        },
        "largest_difference_over_bound": {f"{a}, {b}": value for (a, b), value in study.apart.items()},
    }
    tables = [
        ("error without noise (Table 1)", _exact(study, paper)),
        ("rms error over the noise (Fig. 1)", _fig_1(study)),
    ]
    for what, cell in (
        ("rms error of each parameter over its Cramer-Rao bound", _ratio),
        ("mean error of each parameter over its standard error", _bias),
    ):
        tables.append((f"{what}, at the largest sigma", _at_largest_sigma(study, cell)))
    if starts is not None:
        found = starts.reached.items()
        rows = [[_STARTS[kind][0], str(count), str(len(starts.rms[kind]))] for kind, count in found]
        title = f"single random starts that reach the minimum (noise {starts.sigma:g} px)"
        tables.append((title, [["start", "reached", "of"], *rows]))
        tree["random_starts"] = {
            **attributes(starts, "sigma best_rmse_px=best"),
            "starts": {kind: len(rms) for kind, rms in starts.rms.items()},
            **attributes(starts, "reached rmse_px=rms"),
        }
    below = [
        f"{a} and {b} differ by at most {apart:.1g} of the bound, in any parameter of any trial"
        for (a, b), apart in study.apart.items()
    ]
    below += [
        f"{method} gave no answer in {one.failed.sum()} of {study.trials * len(study.sigma)} trials"
        for method, one in study.methods.items()
        if one.failed.any()
    ]
    return _titled(tree, tables, below)


def _exact(study: NoiseStudy, paper: bool) -> Table:
    printed = ["as printed"] if paper else []
    rows = [["parameter", "truth", *study.methods, *printed]]
    for p, name in enumerate(study.names):
        errors = [_error(one.exact[p]) for one in study.methods.values()]
        rows.append([name, f"{study.truth[p]:.6g}", *errors, *([_error(_PRINTED[name])] if paper else [])])
    return rows


def _error(value: float) -> str:
    return "0" if value == 0 else number(value, ".1e")


def _fig_1(study: NoiseStudy) -> Table:
    rows = [["parameter", "sigma [px]", "bound", *study.methods]]
    # That of the method with the most unknowns.
    bound = max((one.bound for one in study.methods.values()), key=lambda bound: np.count_nonzero(bound > 0))
    for name in FIG_1:
        p = study.names.index(name)
        for k, sigma in enumerate(study.sigma):
            values = [number(one.rms[k, p], ".3g") for one in study.methods.values()]
            rows.append([name, f"{sigma:g}", number(sigma * bound[p], ".3g"), *values])
    return rows


def _at_largest_sigma(study: NoiseStudy, cell: Callable[[NoiseStudy, MethodErrors, int], str]) -> Table:
    """A row for each parameter and a column for each method that estimates it."""
    rows = [["parameter", *study.methods]]
    for p, name in enumerate(study.names):
        cells = [cell(study, one, p) if one.bound[p] != 0 else "given" for one in study.methods.values()]
        rows.append([name, *cells])
    return rows


def _ratio(study: NoiseStudy, one: MethodErrors, p: int) -> str:
    """Rms error over its bound."""
    return number(one.rms[-1, p] / (study.sigma[-1] * one.bound[p]), ".3g")


def _bias(study: NoiseStudy, one: MethodErrors, p: int) -> str:
    """Mean error over its standard error."""
    variance = max(one.rms[-1, p] ** 2 - one.bias[-1, p] ** 2, 0.0)
    spread = np.sqrt(variance / max(study.trials - one.failed[-1], 1))
    return f"{one.bias[-1, p] / spread:+.1f}" if spread > 0 else "-"


def rates_report(study: RateStudy) -> Report:
    """On how many data sets one start converges, for each pair of rates, and how fast."""
    counts = [["weights \\ gamma", *(f"{rate:g}" for rate in study.rates_gamma)]]
    epochs = counts[:]
    for a, rate in enumerate(study.rates_weights):
        counts.append([f"{rate:g}", *map(str, study.converged[a])])
        epochs.append([f"{rate:g}", *("-" if np.isnan(e) else f"{e:.0f}" for e in study.epochs[a])])
    weights, gamma = study.default
    below = [
        f"calibrate --trainer backprop with its rates, {weights:g} and {gamma:g}, reaches the minimum on "
        f"{study.calibrated} of {study.sets} data sets",
        f"there, errors of alpha_u are {np.sqrt((study.alpha_u**2).mean()):.2f} reported standard deviations "
        f"rms, {np.abs(study.alpha_u).max():.1f} at most",
    ]
    title = f"of {study.sets} data sets, those on which a single random start converges with these rates"
    tree = {
        **attributes(study, "data_sets=sets rates_weights rates_gamma converged median_epochs=epochs"),
        "default": {"rate_weights": weights, "rate_gamma": gamma},
        **attributes(study, "calibrated alpha_u_errors_in_std=alpha_u"),
    }
    return Report(tree, [counts, epochs], below, titles=[title, "median epochs of these"])


def rig_study_report(study: RigStudy) -> Report:
    """The errors of a simulated rig, and its true poses."""
    rows = [["sigma [px]", "rms [px]", "place [mm]", "rotation [rad]", "error / std"]]
    columns = study.sigma, study.rmse_px, study.centre, study.rotation, study.over_std
    for noise, rmse, centre, rotation, ratio in zip(*columns, strict=True):
        rows.append([f"{noise:g}", f"{rmse:.4g}", f"{centre:.4g}", f"{rotation:.3g}", f"{ratio:.2f}"])
    n, frames = len(study.rig.cameras), len(study.rig.frames)
    title = f"rms errors of {n} cameras in {plural(study.trials, 'trial')}, {frames} frames"
    below = ["error / std is 1 where the reported standard deviations are right"]
    tree = {
        "trials": study.trials,
        "frames": frames,
        **attributes(study, "sigma_px=sigma rmse_px place_mm=centre rotation_rad=rotation"),
        "error_over_std": study.over_std,
        "poses": {
            name: {"R": pose.R.tolist(), "t": pose.t.tolist()} for name, pose in study.rig.relative.items()
        },
    }
    return Report(tree, [rows], below, titles=[title])


def _by_name(study: NoiseStudy, values: Any) -> dict[str, Any]:
    return dict(zip(study.names, values, strict=True))


def draw_simulation(study: NoiseStudy, starts: StartStudy | None, unit: str, kind: str = "png") -> bytes:
    """Draw the rms errors of four parameters over the noise, and the outcomes of random starts.

    `unit` is that of the world coordinates, and `kind` png, pdf or svg.
    """
    with drawing((6.6, 6.0 if starts is None else 9.0), 0.1, kind) as (figure, file):
        grid = figure.add_gridspec(2 if starts is None else 3, 2)
        for n, name in enumerate(FIG_1):
            _draw_errors(figure.add_subplot(grid[n // 2, n % 2]), study, name, UNITS.get(name, unit), n == 0)
        if starts is not None:
            _draw_starts(figure.add_subplot(grid[2, :]), starts)
    return file.getvalue()


def _draw_errors(axes: Axes, study: NoiseStudy, name: str, unit: str, legend: bool) -> None:
    """Draw each method's rms error of one parameter over the noise, and the bounds."""
    from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter

    p = study.names.index(name)
    bounds = {method: one.bound[p] for method, one in study.methods.items() if one.bound[p] > 0}
    widest = max(bounds.values(), default=0.0)
    over = np.geomspace(0.8 * study.sigma.min(), 1.25 * study.sigma.max(), 2)
    axes.loglog(over, over * widest, color="0.25", linewidth=1.2, label="Cramer-Rao bound")
    told = []
    for method, bound in bounds.items():
        if bound < _OWN * widest:
            label = f"bound of {method}, which is given more"
            (line,) = axes.loglog(over, over * bound, color=_LOOK[method][0], linewidth=1.0, linestyle=":")
            told.append((line, label))
    for method, one in study.methods.items():
        color, marker, size = _LOOK[method]
        hollow = {"markerfacecolor": "none"} if marker in "os^v" else {}
        axes.loglog(
            study.sigma, one.rms[:, p], color=color, marker=marker, markersize=size, linewidth=0.9,
            label=method, **hollow,
        )  # fmt: skip
    style(axes, name)
    axes.set(xlabel="noise sigma [px]", ylabel=f"rms error [{unit}]".replace("$", r"\$"))
    axes.grid(True, which="minor", color="0.95", linewidth=0.4)
    axes.xaxis.set_major_locator(FixedLocator(study.sigma.tolist()))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    if legend:
        axes.legend(frameon=False, fontsize=8, loc="upper left")
    elif told:
        axes.legend(*zip(*told, strict=True), frameon=False, fontsize=8, loc="lower right")


def _draw_starts(axes: Axes, starts: StartStudy) -> None:
    """Draw a bar for each kind: shares of starts that reach the minimum, another one, and no camera."""
    kinds = list(starts.rms)[::-1]
    names = [_STARTS[kind][1] for kind in kinds]
    total = np.array([len(starts.rms[kind]) for kind in kinds])
    best = np.array([starts.reached[kind] for kind in kinds])
    lost = np.array([int(np.isinf(starts.rms[kind]).sum()) for kind in kinds])
    left = np.zeros(len(kinds))
    for counts, color, label in (
        (best, "#009e73", "the minimum"),
        (total - best - lost, "#e69f00", "another one"),
        (lost, "0.75", "no camera"),
    ):
        share = 100 * counts / total
        axes.barh(names, share, left=left, color=color, label=label, height=0.6)
        left += share
    for row, (reached, of) in enumerate(zip(best, total, strict=True)):
        axes.text(2, row, f"{reached} of {of}", va="center", fontweight="bold")
    style(axes, f"Where single random starts end, noise {starts.sigma:g} px")
    axes.set(xlabel="starts [%]", xlim=(0, 100))
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2))


def draw_rates(study: RateStudy, kind: str = "png") -> bytes:
    """Draw, for each pair of rates, on how many data sets a start converges, and how fast."""
    with drawing((5.6, 8.0), 0.12, kind) as (figure, file):
        upper, lower = figure.subplots(2, 1)
        share = 100 * study.converged / study.sets
        labels = [[str(count) for count in row] for row in study.converged]
        _draw_grid(upper, study, share, labels, (0.0, 100.0), dark_is_low=True)
        upper.set_title(f"Data sets of {study.sets} on which one start converges", loc="left")
        known = np.log10(np.where(study.epochs > 0, study.epochs, np.nan))
        texts = [["" if np.isnan(e) else f"{e:.0f}" for e in row] for row in study.epochs]
        limits = float(np.nanmin(known)), float(np.nanmax(known))
        _draw_grid(lower, study, known, texts, limits, dark_is_low=False)
        lower.set_title("Median epochs of these", loc="left")
    return file.getvalue()


def _draw_grid(
    axes: Axes,
    study: RateStudy,
    values: np.ndarray,
    texts: list[list[str]],
    limits: tuple[float, float],
    *,
    dark_is_low: bool,
) -> None:
    """Draw a coloured square with a text for each pair of rates, and a frame about the default ones."""
    from matplotlib.patches import Rectangle

    colours = "viridis" if dark_is_low else "viridis_r"
    axes.imshow(values, origin="lower", cmap=colours, vmin=limits[0], vmax=limits[1], aspect="auto")
    middle = 0.5 * (limits[0] + limits[1])
    for a, row in enumerate(texts):
        for b, text in enumerate(row):
            dark = (values[a, b] < middle) == dark_is_low
            axes.text(b, a, text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
    axes.set_xticks(range(len(study.rates_gamma)), [f"{rate:g}" for rate in study.rates_gamma])
    axes.set_yticks(range(len(study.rates_weights)), [f"{rate:g}" for rate in study.rates_weights])
    axes.set(xlabel="rate of gamma, alpha_2", ylabel="rate of the weights, alpha_1")
    grids = zip((study.rates_weights, study.rates_gamma), study.default, strict=True)
    default_row, default_column = (int(np.abs(grid - rate).argmin()) for grid, rate in grids)
    corner = default_column - 0.5, default_row - 0.5
    axes.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor=ACCENT, linewidth=2))
