"""``neurocal batch``: thousands of data sets in, a camera of each and a summary of all out."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from functools import cache
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.streams import ProgressBar, complain, note, print_summary, say, suggest, warn
from neurocal_cli.errors import NeurocalError, UsageError

if TYPE_CHECKING:
    from neurocal_cli.commands.batch_jobs import Job, Outcome

_CSV, _HTML = "summary.csv", "summary.html"
_MOST_TOLD = 10  # problems of jobs
_STOPPED = 20  # jobs that the machine made fail, after which the batch ends
Run = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[tuple[Any, Any]]]


@frozen_dataclass
class _Workers:
    """The values of the options of what does the jobs."""

    workers: int | None
    jobs: int | None
    scheduler: str | None
    ship: bool

    def check(self) -> None:
        """Refuse options that contradict each other, with a UsageError, and workers of Dask without it."""
        from neurocal_cli.commands import cluster

        ways = {"--workers": self.workers, "--jobs": self.jobs, "--scheduler": self.scheduler}
        chosen = [name for name, value in ways.items() if value]
        if len(chosen) > 1:
            raise UsageError(f"{chosen[0]} and {chosen[1]} contradict each other; give one of them")
        if self.ship and self.scheduler is None:
            raise UsageError("--ship is for the workers of a --scheduler; leave it out")
        if not cluster.is_installed() and (self.workers or self.scheduler):
            raise NeurocalError(f"{chosen[0]} needs Dask; pip install 'dask[distributed]', or use --jobs")

    def run(self, stack: ExitStack, folder: str) -> Run:
        """What does tasks: processes of this machine, or the workers of a cluster."""
        from neurocal_cli.commands import cluster
        from neurocal_cli.files.batch_files import owner_of
        from neurocal_cli.files.processes import usable_cores, work_off

        if self.scheduler is not None:
            client = stack.enter_context(cluster.running_cluster(self.scheduler))
            if not self.ship and (blind := cluster.see(client, *owner_of(folder))):
                raise NeurocalError(
                    f"the worker {blind[0]} does not see {folder}; put it where all workers see it, or give "
                    "--ship"
                )
        elif self.jobs is not None or not cluster.is_installed():
            return lambda work, tasks: work_off(work, tasks, self.jobs or usable_cores())
        else:
            client = stack.enter_context(cluster.local_cluster(self.workers or usable_cores()))
        return lambda work, tasks: cluster.work_off_by(client, work, tasks, ahead=1 if self.ship else 4)


@click.command(cls=options.Command)
@options.argument(
    "manifest",
    "MANIFEST.csv|FOLDER",
    "A CSV file with a row for each data set, or a folder: each of its leaf folders with images, or points, "
    "is a data set.",
)
@options.pairs(
    "--set",
    "COLUMN=VALUE",
    "A column of the manifest for all data sets that do not have it, such as board=board.yaml or "
    "distortion=k1k2. It can be repeated.",
    to="common",
)
@options.path(
    "--against",
    "SUMMARY.csv",
    "Compare each camera with that of the same name in an earlier summary, and mark those that have changed, "
    "as neurocal drift does, and cameras of rigs that have moved.",
)
@options.collected(
    _Workers,
    [
        options.count(
            "--workers",
            "N",
            "Number of Dask workers to start on this machine; needs the extra fleet.",
            without="the number of cores",
        ),
        options.count(
            "--jobs", "N", "Number of processes on this machine, without Dask.", without="Dask workers"
        ),
        options.path(
            "--scheduler",
            "ADDRESS",
            "Use the workers of this running Dask scheduler, such as tcp://host:8786.",
        ),
        options.flag(
            "--ship",
            "With --scheduler: send the inputs to workers that do not see the files, and fetch the results.",
        ),
    ],
    "workers",
)
@options.flag("--force", "Do all jobs again, also those that are done.")
@options.json
@options.output("DIR", "Folder for the results: DIR/NAME for each data set, and the summary.", required=True)
def batch(
    manifest: str,
    common: options.Named,
    against: str | None,
    workers: _Workers,
    force: bool,
    as_json: bool,
    output: str,
) -> None:
    """Calibrate many data sets, and summarise the fleet.

    Each data set is a job: its images are measured, its camera is calibrated, and a report is made. The
    results are in DIR/NAME: points, camera.yaml (or rig.yaml, lens.yaml), report.html and log.txt, the same
    bytes that its commands write one by one; the log begins with them.

    A manifest has a column `name`, and columns that say what there is: `images` (a pattern, a folder, a
    video) or `points` (CSV); `right` as well for a stereo pair; `cam0`, `cam1`, ... for a rig; or `lens`, the
    points of a zoom lens. Paths are relative to the manifest. All other columns are options of neurocal
    detect, calibrate, stereo, rig and lens fit by their names: `board`, `cols`, `distortion`, `no-skew` (yes
    or no), and `measure` for detect's --points. In a tree of folders, left.csv and right.csv beside each
    other are a stereo pair, cam0.csv, cam1.csv, ... a rig, and board.yaml describes the images in its folder
    and below.

    The batch can be stopped at any time. The same command goes on where it was: a job is not done again if
    its commands, the contents of its inputs and the version of neurocal are the same. If a worker dies, its
    job is tried once more.

    summary.csv has a row for each camera, and summary.html shows the fleet: its verdicts, histograms of its
    parameters, and cameras far from the others. The exit status is 0 if all jobs are done, and 1 if some
    failed; their reasons are in the summary.

    \b
    Examples:
      neurocal sample sample_data
      printf 'name,points\\nfront,flat.csv\\nrear,stereo_left.csv\\n' \\
          > sample_data/fleet.csv
      neurocal batch sample_data/fleet.csv --set distortion=k1 --jobs 2 -o first
      neurocal batch sample_data/fleet.csv --set distortion=k1 --jobs 1 --force --json \\
          --against first/summary.csv -o second
      # with the extra fleet:
      # neurocal batch sample_data/fleet.csv --workers 2 -o third
      # neurocal batch sample_data/fleet.csv --scheduler tcp://host:8786 \\
      #     --ship -o third
    """  # noqa: D301 - as in the group
    workers.check()
    preparation.check_folder("-o", output)
    from neurocal_cli.commands.batch_jobs import job_of
    from neurocal_cli.files.batch_files import locked, read_data_sets, read_fleet

    former = {} if against is None else read_fleet(against)
    folder = os.path.realpath(output)
    columns = {name.lower().replace("_", "-"): value for name, value in common}
    if against is not None and os.path.dirname(os.path.realpath(against)) == folder:
        raise UsageError("--against is the summary of this folder, which is written anew; give another -o")
    if os.path.realpath(manifest) == folder:
        raise UsageError("-o is the folder of the data sets; give another one for the results")
    todo = [job_of(one, columns, folder) for one in read_data_sets(manifest)]
    os.makedirs(folder, exist_ok=True)
    with ExitStack() as stack:
        stack.enter_context(locked(folder))
        run = cache(lambda: workers.run(stack, folder))
        _Batch(folder, output, todo, run, workers.ship, force).carry_out(former, as_json)


class _Batch:
    """The jobs of a batch, and what became of them."""

    def __init__(
        self, folder: str, shown: str, jobs: list[Job], run: Callable[[], Run], ship: bool, force: bool
    ) -> None:
        self._folder, self._shown, self._jobs, self._run = folder, shown, jobs, run
        self._ship, self._force = ship, force
        self._outcomes: dict[str, Outcome] = {}
        self._start = time.perf_counter()

    def carry_out(self, former: dict[tuple[str, str], str], as_json: bool) -> None:
        """Do the jobs, compare their cameras with former ones, and write the summary."""
        changes: dict[tuple[str, str], dict[str, Any]] = {}
        try:
            self._do_jobs()
            changes = self._compared(former)
        except KeyboardInterrupt:
            self._write(changes)
            complain(
                f"{len(self._outcomes)} of {len(self._jobs)} jobs are done; the same command goes on there"
            )
            raise
        rows = self._write(changes)
        self._tell(rows, as_json)
        if any(outcome.status != "done" for outcome in self._outcomes.values()):
            click.get_current_context().exit(1)

    def _do_jobs(self) -> None:
        from neurocal_cli.commands.batch_jobs import Outcome
        from neurocal_cli.commands.batch_run import Task, do_job, receive, unchanged, with_inputs

        tasks = []
        for job in self._jobs:
            task = Task(job, os.path.join(self._folder, job.name), self._force)
            if job.problem:
                self._outcomes[job.name] = Outcome("failed", job.problem)
            elif (outcome := unchanged(task)) is not None:
                self._outcomes[job.name] = outcome
            else:
                tasks.append(task)
        if not tasks:
            return
        n_before, stopped = len(self._outcomes), 0
        sent = map(with_inputs, tasks) if self._ship else tasks  # read when it is their turn
        with ProgressBar() as progress:
            progress(f"0 of {len(tasks)} jobs", 0.0)
            for task, result in self._run()(do_job, sent):
                if result is None:
                    outcome = Outcome("failed", "its process was killed twice, perhaps for lack of memory")
                else:
                    outcome = receive(task, result) if self._ship else result
                self._outcomes[task.job.name] = outcome
                stopped = stopped + 1 if outcome.status == "stopped" else 0
                if stopped >= _STOPPED:
                    done = sum(o.status == "done" for o in self._outcomes.values())
                    raise NeurocalError(
                        f"{outcome.problem}; {done} of {len(self._jobs)} jobs are done, and the same command "
                        "goes on there"
                    )
                n = len(self._outcomes) - n_before
                rate = n / (time.perf_counter() - self._start)
                left = time.gmtime((len(tasks) - n) / rate)
                progress(
                    f"{n} of {len(tasks)} jobs, {rate:.3g}/s, {time.strftime('%H:%M:%S', left)} left",
                    n / len(tasks),
                )

    def _compared(self, former: dict[tuple[str, str], str]) -> dict[tuple[str, str], dict[str, Any]]:
        """What changed since an earlier batch, by the names of job and camera."""
        if not former:
            return {}
        from neurocal_cli.commands.batch_run import Pair, compare
        from neurocal_cli.files.processes import usable_cores, work_off

        pairs = [
            Pair(job.name, row["camera"], old, os.path.join(self._folder, job.name, job.result))
            for job in self._jobs
            for row in self._recorded(job)
            if (old := former.get((job.name, row["camera"])))
        ]
        missing = len(former) - len(pairs)
        if missing > 0:
            note(f"{missing} cameras of the earlier summary have no counterpart here")
        found: dict[tuple[str, str], dict[str, Any]] = {}
        with ProgressBar() as progress:
            done = work_off(compare, pairs, usable_cores()) if self._ship else self._run()(compare, pairs)
            for pair, result in done:
                found[pair.name, pair.camera] = result or {"drift": "unknown: its process was killed"}
                progress(f"{len(found)} of {len(pairs)} cameras compared", len(found) / len(pairs))
        return found

    def _recorded(self, job: Job) -> list[dict[str, Any]]:
        """The rows of a job, read from its record when they are needed: those of a large fleet are large."""
        from neurocal_cli.files.batch_files import read_record

        outcome = self._outcomes.get(job.name)
        known = outcome is not None and outcome.seconds is not None
        rows = read_record(os.path.join(self._folder, job.name)).get("rows", []) if known else []
        return [{_once(key): _once(value) for key, value in row.items()} for row in rows]

    def _write(self, changes: dict[tuple[str, str], dict[str, Any]]) -> list[dict[str, Any]]:
        """Write the summary of what is done, at once, and return its rows."""
        from neurocal_cli.commands.show.fleet import fleet_page, fleet_rows
        from neurocal_cli.files.batch_files import format_fleet
        from neurocal_cli.files.writing import write_at_once

        rows = fleet_rows(self._jobs, self._outcomes, changes, self._recorded)
        write_at_once(os.path.join(self._folder, _CSV), format_fleet(rows))
        write_at_once(os.path.join(self._folder, _HTML), fleet_page(rows, os.path.basename(self._folder)))
        return rows

    def _tell(self, rows: list[dict[str, Any]], as_json: bool) -> None:
        """Report what was done, and what stands out."""
        from neurocal_cli.commands.show.fleet import drift_text

        outcomes = self._outcomes
        failed = {name: one.problem for name, one in outcomes.items() if one.status != "done"}
        for name, problem in list(failed.items())[:_MOST_TOLD]:
            complain(f"{name}: {problem}")
        if len(failed) > _MOST_TOLD:
            complain(f"and {len(failed) - _MOST_TOLD} more; see {os.path.join(self._shown, _CSV)}")
        n_unchanged = sum(one.unchanged for one in outcomes.values())
        verdicts = Counter(row["verdict"] for row in rows if row.get("verdict"))
        outliers = [row for row in rows if row["outlier"]]
        changed = {_named(row): text for row in rows if (text := drift_text(row))}
        seconds = time.perf_counter() - self._start
        if as_json:
            print_summary(
                {
                    "n_jobs": len(outcomes),
                    "n_done": len(outcomes) - len(failed),
                    "n_unchanged": n_unchanged,
                    "failed": failed,
                    "verdicts": dict(verdicts),
                    "outliers": {_named(row): row["outlier"] for row in outliers},
                    "changed": changed,
                    "seconds": seconds,
                }
            )
            return
        for row in outliers:
            warn(f"{_named(row)}: {row['outlier']}")
        for name, text in changed.items():
            warn(f"{name}: {text}")
        n_new = len(outcomes) - n_unchanged
        say(
            f"{len(outcomes) - len(failed)} of {len(outcomes)} jobs are done"
            + (f", {n_unchanged} jobs are as they were" if n_unchanged else "")
            + (f"; {n_new} in {seconds:.1f} s, {n_new / seconds:.3g}/s" if n_new else "")
        )
        if verdicts:
            say(f"verdicts: {', '.join(f'{count} {word}' for word, count in verdicts.most_common())}")
        say(f"summary: {os.path.join(self._shown, _CSV)} and {os.path.join(self._shown, _HTML)}")
        suggest(os.path.join(self._shown, _HTML), "open {} in a browser")


def _named(row: dict[str, Any]) -> str:
    return f"{row['name']} {row['camera']}".strip()


def _once(value: Any) -> Any:
    """A value of a row; the same words in thousands of rows are kept once."""
    return sys.intern(value) if isinstance(value, str) else value
