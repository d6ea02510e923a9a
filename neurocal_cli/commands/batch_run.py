"""What a worker process does for a batch: a job in a folder of its own, and the comparison of two cameras."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from contextvars import Context
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from neurocal_cli import __version__
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.commands.batch_jobs import LOG, Job, Outcome, Words, parsed
from neurocal_cli.commands.show.fleet import rows_of
from neurocal_cli.commands.streams import captured, one_line, tell
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.batch_files import (
    RECORD,
    fingerprints,
    is_of_machine,
    key_of,
    publish,
    read_record,
    sizes_of,
    unread_since,
    work_folder,
)
from neurocal_cli.files.reading import read_bytes
from neurocal_cli.files.writing import all_or_none, write_at_once

if TYPE_CHECKING:
    from neurocal_cli.calibration.drift import Drift

# The working folder is that of the whole process, and so are some settings of libraries.
_ONE_AT_A_TIME = threading.Lock()


@frozen_dataclass(eq=False)
class Task:
    """A job to do."""

    job: Job
    results: str  # absolute path of its folder of results
    force: bool = False
    # Contents of its inputs by name, if the worker does not see the files; results are sent back then.
    shipped: Mapping[str, bytes] | None = None


def do_job(task: Task) -> Outcome:
    """Do a job, unless its results are those of the same commands, inputs and version."""
    with _ONE_AT_A_TIME:
        try:
            return Context().run(_done if task.shipped is None else _done_elsewhere, task)
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            return Outcome("stopped" if is_of_machine(error) else "failed", one_line(text))


def unchanged(task: Task) -> Outcome | None:
    """The outcome of a job that is done already, told by a glance at its inputs; else None."""
    record = {} if task.force else read_record(task.results)
    inputs = record.get("inputs", {})
    if list(inputs) != list(task.job.inputs) or not unread_since(task.results, inputs):
        return None
    key = key_of(task.job.steps, [entry["sha256"] for entry in inputs.values()])
    return replace(_recorded(record), unchanged=True) if record.get("key") == key else None


def _recorded(record: Mapping[str, Any]) -> Outcome:
    return Outcome(record["status"], record["problem"], record["seconds"])


def with_inputs(task: Task) -> Task:
    """The task with the contents of its inputs, without those that cannot be read."""
    shipped = {}
    for name in task.job.inputs:
        with suppress(NeurocalError):
            shipped[name] = read_bytes(os.path.normpath(os.path.join(task.results, name)))[0]
    return replace(task, shipped=shipped)


def receive(task: Task, outcome: Outcome) -> Outcome:
    """Write the results that a worker sent, and their record."""
    if outcome.sent is None:
        return outcome
    inputs = fingerprints(task.results, task.job.inputs, {})
    key = key_of(task.job.steps, [entry["sha256"] for entry in inputs.values()])
    record, files = outcome.sent
    record = {"key": key, "inputs": inputs} | record
    try:
        work = work_folder(task.results)
        for name, content in files.items():
            write_at_once(os.path.join(work, name), content)
        write_at_once(os.path.join(work, RECORD), json.dumps(record, indent=1) + "\n")
        publish(work, task.results)
    except (NeurocalError, OSError) as error:
        return Outcome("stopped", one_line(str(error)))
    return replace(outcome, sent=None)


def _done(task: Task) -> Outcome:
    job, results = task.job, task.results
    former = {} if task.force else read_record(results)
    inputs = fingerprints(results, job.inputs, former.get("inputs", {}))
    key = key_of(job.steps, [entry["sha256"] for entry in inputs.values()])
    if former.get("key") == key:
        return replace(_recorded(former), unchanged=True)
    work = work_folder(results)
    try:
        record = _worked(job, work, {"key": key, "inputs": inputs})
        if record["status"] != "stopped":
            publish(work, results)
        return _recorded(record)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _done_elsewhere(task: Task) -> Outcome:
    """Do a job whose inputs were sent, in a folder that looks the same from the folder of the results."""
    assert task.shipped is not None
    with tempfile.TemporaryDirectory(prefix="neurocal-") as root:
        up = max((name.split(os.sep).count(os.pardir) for name in task.shipped), default=0)
        work = os.path.join(root, *("d" * up), os.path.basename(task.results))
        os.makedirs(work)
        for name, content in task.shipped.items():
            path = os.path.normpath(os.path.join(work, name))
            os.makedirs(os.path.dirname(path), exist_ok=True)
            write_at_once(path, content)
        before = set(os.listdir(work))
        record = _worked(task.job, work, {})
        made = sorted(set(os.listdir(work)) - before - {RECORD})
        files = {name: read_bytes(os.path.join(work, name))[0] for name in made}
        return replace(_recorded(record), sent=None if record["status"] == "stopped" else (record, files))


def _worked(job: Job, work: str, record: dict[str, Any]) -> dict[str, Any]:
    """Run the commands in a folder, and write the log and the record there; return the record."""
    start, lines = time.perf_counter(), list[str]()
    summaries: list[dict[str, Any]] = []
    status, problem, former = "done", "", os.getcwd()
    os.chdir(work)
    try:
        for words in job.steps:
            lines.append(f"$ {shlex.join(('neurocal', *words))}")
            code, problem, machine = _run(words, lines, summaries)
            if machine:
                return {"status": "stopped", "problem": problem, "seconds": None}
            if code == 3:
                status, problem = "not converged", "training did not converge"
            elif code:
                status = "failed"
                break
        write_at_once(LOG, "\n".join(lines) + "\n")
    finally:
        with suppress(OSError):  # it may be gone
            os.chdir(former)
    record |= {
        "neurocal": __version__,
        "steps": job.lines,
        "status": status,
        "problem": problem,
        "seconds": round(time.perf_counter() - start, 3),
        "rows": rows_of(summaries[-1]) if summaries else [],
        "outputs": sizes_of(work),
    }
    write_at_once(os.path.join(work, RECORD), json.dumps(record, indent=1) + "\n")
    return record


def _run(words: Words, lines: list[str], summaries: list[dict[str, Any]]) -> tuple[int, str, bool]:
    """Run one command; return its exit status, its error in one line, and whether that is the machine's."""
    with captured() as capture:
        code, problem, machine = 0, "", False
        try:
            with all_or_none(finishing=(click.exceptions.Exit,)), parsed(words) as context:
                context.command.invoke(context)
        except click.exceptions.Exit as end:
            code = end.exit_code
        except click.ClickException as error:
            code, problem = error.exit_code, error.format_message()
        except NeurocalError as error:
            code, problem, machine = error.exit_code, str(error), is_of_machine(error)
        except Exception as error:
            problem = f"internal error: {type(error).__name__}: {error}"
            code, machine = 1, is_of_machine(error)
        if problem:
            problem = one_line(problem)
            tell(f"Error: {problem}")
    lines += capture.lines
    summaries += capture.summaries
    return code, problem, machine


@frozen_dataclass
class Pair:
    """An earlier and a new camera: the names of job and camera, and their files."""

    name: str
    camera: str
    old: str
    new: str


def compare(pair: Pair) -> dict[str, Any]:
    """What changed, as cells of the summary; the drift is "unknown" and the reason if that cannot be said."""
    return Context().run(_compared, pair)


def _compared(pair: Pair) -> dict[str, Any]:
    from neurocal_cli.calibration.drift import find_drift
    from neurocal_cli.files.calibration_yaml import read_calibration

    try:
        if not pair.camera:
            return _in_image(find_drift(read_calibration(pair.old), read_calibration(pair.new)))
        return _in_rigs(pair)
    except NeurocalError as error:
        return {"drift": f"unknown: {error}"}


def _in_rigs(pair: Pair) -> dict[str, Any]:
    """What changed in a camera of a rig, and in its pose relative to the first camera."""
    from neurocal_cli.calibration.drift import find_drift
    from neurocal_cli.calibration.rig.rig_drift import find_pose_drift
    from neurocal_cli.files.rig_yaml import read_rig

    old, new, name = read_rig(pair.old), read_rig(pair.new), pair.camera
    if name not in old.cameras:
        raise NeurocalError(f"{pair.old} has no camera {name}")
    cells = _in_image(find_drift(old.cameras[name], new.cameras[name]))
    if name == new.first:
        return cells
    moved = find_pose_drift(old, new, name)
    return cells | {
        "turn_rad": float(np.linalg.norm(moved.turn)),
        "turn_std_rad": float(np.linalg.norm(moved.turn_std)),
        "baseline_change": moved.baseline,
        "baseline_change_std": moved.baseline_std,
        "pose_share": moved.share,
    }


def _in_image(found: Drift) -> dict[str, Any]:
    return {
        "drift": "same",  # or what has changed, which depends on the number of cameras
        "drift_px": found.rms_px,
        "drift_std_px": found.rms_std,
        "drift_share": found.share,
    }
