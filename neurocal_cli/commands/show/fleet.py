"""The summary of a fleet: a row for each camera of each job, and the page with histograms and a table."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

import numpy as np

from neurocal_cli.calibration.drift import FAR, SHARE, fleet_sigmas
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.batch_jobs import Job, Outcome
from neurocal_cli.commands.show.html_page import figure, page, section
from neurocal_cli.errors import one_line

Row = dict[str, Any]
# Parameters that have a column; a rich lens has dozens more.
_NAMED = re.compile(r"alpha_[uv]|[uv]0|theta|[kps]\d|tau_[xy]|xi|alpha|beta")
# Parameters that are compared with those of the fleet.
_OF_FLEET = ("alpha_u", "alpha_v", "u0", "v0", "baseline")
_FALSE = 0.1  # share of batches with any unchanged camera that is said to have changed
# What has happened if the chance of an unchanged camera, and of an unchanged pose, is too small.
_SHARES = {"drift_share": "changed", "pose_share": "moved"}
_NOT_DONE = Outcome("not done")
_MEASURES = {"held_out_px": "held_out_px", "projection_px": "std_px"}
_MOST_ROWS = 5000  # a browser sorts them at once
_BINS = 24
_WITHIN = 8.0  # fleet sigmas that a histogram shows
_DRAWN = {"alpha_u": "px", "alpha_v": "px", "u0": "px", "v0": "px", "rmse_px": "px", "held_out_px": "px"}
_FEWEST = 5  # cameras for a histogram
_WIDTH, _HEIGHT, _FOOT = 320.0, 130.0, 24.0
_WORDS = ("good", "usable", "poor")
# Columns of the table: heading, key and format. Those that no row has are left out.
_COLUMNS = (
    ("verdict", "verdict", ""), ("drift", "drift", ""), ("drift rms [px]", "drift_px", "#.2g"),
    ("its std [px]", "drift_std_px", "#.2g"), ("alpha_u [px]", "alpha_u", ".2f"),
    ("its std [px]", "alpha_u_std", "#.2g"), ("alpha_v [px]", "alpha_v", ".2f"), ("u0 [px]", "u0", ".2f"),
    ("v0 [px]", "v0", ".2f"), ("baseline", "baseline", ".6g"), ("distortion model", "distortion", ""),
    ("rms [px]", "rmse_px", "#.3g"), ("cross-validation error [px]", "held_out_px", "#.3g"),
    ("views", "n_views", ""), ("points", "n_points", ""), ("outliers", "n_rejected", ""),
    ("time [s]", "seconds", "#.2g"),
)  # fmt: skip


def rows_of(summary: Mapping[str, Any]) -> list[Row]:
    """The rows of a job from the summary of its result; None for what does not exist."""
    baselines: dict[str, tuple[float, float | None]] = {}
    if "cameras" in summary:
        cameras, poses = dict(summary["cameras"]), summary["poses"]
        for name in list(cameras)[1:]:
            baselines[name] = float(np.linalg.norm(poses[name]["t"])), poses[name]["std"]["baseline"]
    elif "left" in summary:
        cameras = {side: summary[side] for side in ("left", "right")}
        baselines["right"] = summary["baseline"], summary["baseline_std"]
    elif "controls" in summary:  # a zoom lens has no single camera
        own = {key: summary[key] for key in ("n_points", "rmse_px", "distortion")}
        return [_judged(summary) | {"camera": ""} | own]
    else:
        cameras = {"": summary}
    rows = [_judged(summary) | _camera(name, one) for name, one in cameras.items()]
    for row in rows:
        if row["camera"] in baselines:
            row["baseline"], row["baseline_std"] = baselines[row["camera"]]
    return rows


def _judged(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The verdict on the whole result."""
    verdict = summary.get("verdict", {"word": "", "reasons": [], "measures": {}})
    measures = {to: verdict["measures"].get(name) for name, to in _MEASURES.items()}
    return {"verdict": verdict["word"], "reasons": "; ".join(verdict["reasons"]), **measures}


def _camera(name: str, summary: Mapping[str, Any]) -> dict[str, Any]:
    size = summary["image_size"]
    row: dict[str, Any] = {"camera": name, "n_views": len(summary["views"])}
    row["image_size"] = "" if size is None else f"{size[0]} x {size[1]}"
    row |= {key: summary[key] for key in ("n_points", "n_rejected", "distortion", "rmse_px")}
    for key, entry in summary["parameters"].items():
        if _NAMED.fullmatch(key):
            row |= {key: entry["value"], f"{key}_std": entry["std"]}
    if name and (own := summary.get("verdict")):
        row |= {to: own["measures"].get(key) for key, to in _MEASURES.items()}
    return row


def fleet_rows(
    jobs: Iterable[Job],
    outcomes: Mapping[str, Outcome],
    changes: Mapping[tuple[str, str], Mapping[str, Any]],
    recorded: Callable[[Job], Sequence[Row]],
) -> list[Row]:
    """All rows in the order of the jobs, with the outliers of the fleet and the cameras that have changed.

    `recorded` gives the rows of a job, if it has any.
    """
    rows: list[Row] = []
    for job in jobs:
        outcome = outcomes.get(job.name, _NOT_DONE)
        status = "failed" if outcome.status == "stopped" else outcome.status
        common: Row = {"name": job.name, "status": status, "seconds": outcome.seconds}
        common |= {"log": outcome.seconds is not None, "problem": outcome.problem}
        for row in recorded(job) or [{"camera": ""}]:
            file = {"file": f"{job.name}/{job.result}"} if "verdict" in row else {}
            change = changes.get((job.name, row["camera"]), {})
            rows.append({**common, **row, **file, "drift": "", **change})
    _mark_outliers(rows)
    shares = [row[key] for row in rows for key in _SHARES if row.get(key) is not None]
    limit = min(SHARE, _FALSE / max(len(shares), 1))
    for row in rows:
        found = [
            word for key, word in _SHARES.items() if (share := row.get(key)) is not None and share < limit
        ]
        row["drift"] = " and ".join(found) or row["drift"]
    return rows


def drift_text(row: Mapping[str, Any]) -> str:
    """What has changed since an earlier batch, in words; "" if nothing has."""
    told, words = [], row.get("drift", "").split(" and ")
    if "changed" in words:
        told.append(
            f"has changed, {row['drift_px']:.2g} px rms over the image (std {row['drift_std_px']:.2g} px)"
        )
    if "moved" in words:
        told.append(
            f"has moved, turned by {1000 * row['turn_rad']:.2g} mrad (std {1000 * row['turn_std_rad']:.2g} "
            f"mrad), its baseline by {row['baseline_change']:+.2g} (std {row['baseline_change_std']:.2g})"
        )
    return "; ".join(told)


def of_one_kind(rows: Iterable[Row]) -> dict[tuple[str, str], list[Row]]:
    """Rows by the name of the camera and the size of its images: cameras that can be compared."""
    kinds: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        kinds.setdefault((row["camera"], row.get("image_size", "")), []).append(row)
    return kinds


def _mark_outliers(rows: Sequence[Row]) -> None:
    """Mark cameras of which a parameter is far from those of the fleet's cameras of their kind."""
    for row in rows:
        row["outlier"] = ""
    for alike in of_one_kind(rows).values():
        for parameter in _OF_FLEET:
            values, std = (
                np.array([np.nan if row.get(key) is None else row[key] for row in alike], dtype=float)
                for key in (parameter, f"{parameter}_std")
            )
            sigmas = fleet_sigmas(values, std)
            for k in np.flatnonzero(np.abs(sigmas) > FAR).tolist():
                found = f"{parameter} is {sigmas[k]:+.1f} sigmas from the fleet"
                alike[k]["outlier"] = "; ".join(filter(None, (alike[k]["outlier"], found)))


def fleet_page(rows: Sequence[Row], name: str) -> str:
    """Make the page of the rows of a summary; it stands beside the folders of the jobs, to which it links."""
    status = Counter(row["status"] for row in {row["name"]: row for row in rows}.values())
    verdicts = Counter(row["verdict"] for row in rows if row.get("verdict"))
    head = f"{sum(status.values())} jobs: {', '.join(f'{count} {word}' for word, count in status.items())}"
    judged = ", ".join(f"{verdicts[word]} {word}" for word in _WORDS if verdicts[word])
    parts = [f'<p class="soft">{escape(head)}{f"; cameras: {judged}" if judged else ""}</p>']
    parts += [
        section("Changed since the earlier batch", _list(rows, drift_text)),
        section("Far from the fleet", _list(rows, lambda row: row.get("outlier", ""))),
        section("Failed", _list({row["name"]: row for row in rows}.values(), lambda row: row["problem"])),
        section("The fleet", *_histograms(rows)),
        section("Cameras", _table(rows)),
    ]
    return page(f"Fleet {one_line(name)}", [part for part in parts if part])


def _list(rows: Iterable[Row], text: Callable[[Row], str]) -> str:
    """The rows that have a text."""
    lines = [f"<li>{_link(row)}: {escape(said)}</li>" for row in rows if (said := text(row))]
    return f"<ul>{''.join(lines[:_MOST_ROWS])}</ul>" if lines else ""


def _link(row: Row) -> str:
    """The name of a row, which leads to its report, or to its log if there is none."""
    file = "report.html" if row.get("file") else "log.txt"
    label = escape(one_line(f"{row['name']} {row['camera']}".strip()))
    if not row.get("log"):
        return label
    return f'<a href="{quote(str(row["name"]))}/{file}">{label}</a>'


def _table(rows: Sequence[Row]) -> str:
    columns = [column for column in _COLUMNS if any(row.get(column[1]) not in (None, "") for row in rows)]
    head = "".join(f"<th>{escape(title)}</th>" for title, _, _ in [("camera", "", ""), *columns])
    lines = []
    for row in rows[:_MOST_ROWS]:
        cells = "".join(f"<td>{_cell(row.get(key), form)}" for _, key, form in columns)
        marked = row.get("outlier") or drift_text(row) or row["status"] != "done"
        lines.append(f"<tr{' class=mark' if marked else ''}><td>{_link(row)}{cells}")
    style = "<style>tr.mark{background:var(--card)}tr.mark a{color:var(--poor)}a{color:var(--accent)}</style>"
    more = len(rows) - _MOST_ROWS
    below = f'<p class="soft">{more} more are in summary.csv</p>' if more > 0 else ""
    content = f"<thead><tr>{head}</tr></thead>\n<tbody>" + "\n".join(lines)
    return f'{style}<div class="wide"><table class="sort">{content}</tbody></table></div>{below}'


def _cell(value: Any, form: str) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return escape(format(value, form).rstrip(".") if form else str(value))


def _histograms(rows: Sequence[Row]) -> list[str]:
    """Histograms of the parameters, for each kind of camera."""
    figures, kinds = [], of_one_kind(rows)
    for (name, size), alike in kinds.items():
        of = f" of {size} px" if len({size for _, size in kinds}) > 1 else ""
        for key, unit in _DRAWN.items():
            values = np.array([row[key] for row in alike if row.get(key) is not None], dtype=float)
            if len(values) >= _FEWEST and np.ptp(values) > 0:
                figures.append(_histogram(values, f"{name} {key}".strip() + of, unit))
    return [f'<div class="figures">{"".join(figures)}</div>'] if figures else []


def _histogram(values: Array, label: str, unit: str) -> str:
    sigmas = np.abs(fleet_sigmas(values, np.zeros(len(values))))
    near = values[sigmas <= _WITHIN]
    if not len(near) or np.ptp(near) == 0:
        near = values
    counts, edges = np.histogram(near, bins=_BINS)
    each, tallest = _WIDTH / _BINS, max(int(counts.max()), 1)
    bars = "".join(
        f'<rect x="{k * each + 0.5:.1f}" y="{_HEIGHT * (1 - count / tallest):.1f}" width="{each - 1:.1f}" '
        f'height="{_HEIGHT * count / tallest:.1f}" class="bar"><title>{edges[k]:.6g} to {edges[k + 1]:.6g}: '
        f"{count}</title></rect>"
        for k, count in enumerate(counts.tolist())
    )
    low, high = f"{edges[0]:.5g}", f"{edges[-1]:.5g}"
    texts = (
        f'<text x="0" y="{_HEIGHT + 15}" font-size="11">{low}</text>'
        f'<text x="{_WIDTH}" y="{_HEIGHT + 15}" font-size="11" text-anchor="end">{high}</text>'
    )
    drawing = (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT + _FOOT:.0f}" role="img" '
        f'aria-label="histogram of {escape(label)}">'
        f'<path d="M0 {_HEIGHT}H{_WIDTH}" class="axis" style="stroke-width:1"/>{bars}{texts}</svg>'
    )
    beyond = len(values) - len(near)
    caption = f"{label} [{unit}]: median {np.median(values):.6g}, {len(values)} cameras"
    return figure(drawing, caption + (f"; {beyond} lie beyond the drawing" if beyond else ""))
