"""The rows of a fleet's summary: one for each camera of each job."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from neurocal_cli.calibration.drift import SHARE
from neurocal_cli.calibration.fleet import FAR, fleet_sigmas
from neurocal_cli.commands.batch_jobs import Job, Outcome

Row = dict[str, Any]

# Parameters that have a column; a rich lens has dozens more.
_NAMED = re.compile(r"alpha_[uv]|[uv]0|theta|[kps]\d|tau_[xy]|xi|alpha|beta")
_OF_FLEET = (
    "alpha_u",
    "alpha_v",
    "u0",
    "v0",
    "baseline",
)  # parameters that are compared with those of the fleet
_FALSE = 0.1  # share of batches with any unchanged camera that is said to have changed
# What has happened if the chance of an unchanged camera, and of an unchanged pose, is too small.
_SHARES = {"drift_share": "changed", "pose_share": "moved"}
_NOT_DONE = Outcome("not done")
_MEASURES = {"held_out_px": "held_out_px", "projection_px": "std_px"}


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
