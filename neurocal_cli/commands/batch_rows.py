"""The rows of a fleet's summary: one for each camera of each job."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.drift import SHARE
from neurocal_cli.calibration.fleet import FAR, fleet_sigmas

if TYPE_CHECKING:
    from neurocal_cli.commands.batch_jobs import Job, Outcome

# Parameters that have a column; a rich lens has dozens more.
_NAMED = re.compile(r"alpha_[uv]|[uv]0|theta|[kps]\d|tau_[xy]|xi|alpha|beta")
_OF_FLEET = ("alpha_u", "alpha_v", "u0", "v0")  # parameters that are compared with those of the fleet
_FALSE = 0.1  # share of batches with any unchanged camera that is said to have changed
_MEASURES = {"held_out_px": "held_out_px", "projection_px": "std_px"}


def rows_of(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of a job from the summary of its result; None for what does not exist."""
    if "cameras" in summary:
        cameras = dict(summary["cameras"])
    elif "left" in summary:
        cameras = {side: summary[side] for side in ("left", "right")}
    elif "controls" in summary:  # a zoom lens has no single camera
        own = {key: summary[key] for key in ("n_points", "rmse_px", "distortion")}
        return [_judged(summary) | {"camera": ""} | own]
    else:
        cameras = {"": summary}
    return [_judged(summary) | _camera(name, one) for name, one in cameras.items()]


def _judged(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The verdict on the whole result."""
    verdict = summary.get("verdict", {"word": "", "reasons": [], "measures": {}})
    measures = {to: verdict["measures"].get(name) for name, to in _MEASURES.items()}
    return {"verdict": verdict["word"], "reasons": "; ".join(verdict["reasons"]), **measures}


def _camera(name: str, summary: Mapping[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {"camera": name, "n_views": len(summary["views"])}
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
) -> list[dict[str, Any]]:
    """All rows in the order of the jobs, with the outliers of the fleet and the cameras that have changed."""
    rows: list[dict[str, Any]] = []
    for job in jobs:
        outcome = outcomes.get(job.name)
        record = {} if outcome is None else outcome.record
        status = record.get("status", "not done" if outcome is None else "failed")
        common = {"name": job.name, "status": status, "seconds": record.get("seconds"), "log": bool(record)}
        common["problem"] = "" if outcome is None else outcome.problem
        for row in record.get("rows") or [{"camera": ""}]:
            found = {"file": f"{job.name}/{job.result}"} if "verdict" in row else {}
            rows.append(common | row | found | {"drift": ""} | changes.get((job.name, row["camera"]), {}))
    _mark_outliers(rows)
    limit = min(SHARE, _FALSE / max(len(changes), 1))
    for row in rows:
        if row.get("drift_share") is not None and row["drift_share"] < limit:
            row["drift"] = "changed"
    return rows


def _mark_outliers(rows: Sequence[dict[str, Any]]) -> None:
    """Mark cameras of which a parameter is far from those of the fleet's cameras of the same name."""
    for row in rows:
        row["outlier"] = ""
    for name in dict.fromkeys(row["camera"] for row in rows):
        alike = [row for row in rows if row["camera"] == name]
        for parameter in _OF_FLEET:
            values, std = (
                np.array([np.nan if row.get(key) is None else row[key] for row in alike], dtype=float)
                for key in (parameter, f"{parameter}_std")
            )
            sigmas = fleet_sigmas(values, std)
            for k in np.flatnonzero(np.abs(sigmas) > FAR).tolist():
                found = f"{parameter} is {sigmas[k]:+.1f} sigmas from the fleet"
                alike[k]["outlier"] = "; ".join(filter(None, (alike[k]["outlier"], found)))
