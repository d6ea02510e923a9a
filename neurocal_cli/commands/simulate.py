"""``neurocal simulate``: Monte Carlo calibrations of known cameras, whose errors are known."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import boards, options, preparation
from neurocal_cli.commands.preparation import Plots, plot_option, write_plots
from neurocal_cli.commands.streams import ProgressBar, note
from neurocal_cli.errors import DegenerateGeometryError, FormatError, UsageError
from neurocal_cli.files.writing import make_folder, write_whole

if TYPE_CHECKING:
    from neurocal_cli.simulation.scenes import SimulatedScene
    from neurocal_cli.simulation.starts import StartStudy

_SIGMA = (0.1, 0.2, 0.5, 1.0, 2.0)
_FLAT_VIEWS = 10
_RIG_FRAMES, _MOST_CAMERAS = 60, 64
_STARTS_SIGMA = 0.5  # px


class _Command(options.Command):
    """A command that takes several values after --sigma, as in ``--sigma 0.5 1 2``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse, after each value has got an option of its own."""
        expanded: list[str] = []
        after = False
        for word in args:
            more = after and _is_number(word)
            if more and expanded[-1] != "--sigma":
                expanded.append("--sigma")
            expanded.append(word)
            after = more or word == "--sigma"
        return super().parse_args(ctx, expanded)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@click.command(cls=_Command)
@options.path(
    "--camera",
    "CAMERA.yaml",
    "The true camera: a neurocal, ROS or OpenCV file. A neurocal file also brings its points and poses.",
    without="the camera of the paper's Table 1",
)
@options.path(
    "--board",
    "BOARD.yaml",
    "The target, as for detect; the points are its mid-points.",
    without="two boards at a right angle, 440 points",
)
@options.count(
    "--views",
    "N",
    "Number of random poses of the target. Without it, that of Table 1 or those of CAMERA.yaml.",
    without="1, and 10 of a flat board",
    most=1000,
)
@options.number(
    "--sigma",
    "PX...",
    "Standard deviations of the noise in u and in v.",
    without="0.1 0.2 0.5 1 2",
    default=_SIGMA,
    positive=True,
    multiple=True,
)
@options.count("--trials", "N", "Number of trials at each sigma, as in the paper.", default=50)
@options.methods("neuro,nonlinear,linear,tsai")
@options.count(
    "--random-starts",
    "N",
    "Number of single random starts of the network and of plain Levenberg-Marquardt; 0 leaves them out.",
    default=50,
    least=0,
)
@options.path(
    "--rig",
    "LAYOUT:N",
    "Simulate a rig of N cameras instead, in a line, a ring, a star or in two groups (facing), which see a "
    "board of 6 x 5 corners in --views frames.",
    without="one camera",
)
@options.flag(
    "--rates",
    "Study the two learning rates of backprop instead, on many data sets.",
    without="noise and random starts",
)
@options.count("--data-sets", "N", "With --rates: number of data sets.", default=70)
@options.count("--seed", "S", "Seed of everything that is random.", default=0, least=0)
@options.count(
    "--jobs",
    "N",
    "Number of processes; the results are the same for any number.",
    without="the number of cores",
)
@options.path(
    "--save", "DIR", "Write the true camera, its exact points and noisy points of each sigma to this folder."
)
@options.flag(
    "--images",
    "With --save: also write rendered images of the target, and the exact points that they show.",
    without="points only",
)
@plot_option("the errors over the noise and the random starts, or with --rates the rates,")
@options.json
def simulate(
    camera: str | None,
    board: str | None,
    views: int | None,
    sigma: tuple[float, ...],
    trials: int,
    methods: tuple[str, ...],
    random_starts: int,
    rig: str | None,
    rates: bool,
    data_sets: int,
    seed: int,
    jobs: int | None,
    save: str | None,
    images: bool,
    plots: Plots,
    as_json: bool,
) -> None:
    """Calibrate simulated cameras, and compare the methods' errors.

    A camera looks at a target, and noise is added to the exact pixels. All methods calibrate from the same
    points. The command prints each method's error without noise; its rms error over many trials for each
    noise level, next to the Cramer-Rao bound, the smallest error of any unbiased method; its mean error;
    and the share of single random starts that reach the minimum of the reprojection error, for the
    network and for plain Levenberg-Marquardt. Without options it repeats the paper's section 5.1.

    A method that needs given parameters gets the true ones: tsai the image centre and zero skew, opencv
    zero skew. Its bound is then that with fewer unknowns. Pose parameters are averaged over all views.

    With --rig, a rig of many cameras is calibrated by `neurocal rig` in each trial, and the command prints
    the errors of the cameras' places and rotations. With --save it writes the true poses and the points of
    each camera.

    With --rates, the paper's trainer is run from one random start on each of many data sets, with each pair
    of a grid of learning rates.

    \b
    Examples:
      neurocal sample sample_data
      neurocal simulate --trials 10 --sigma 0.2 1 --random-starts 10 --plot fig1.png
      neurocal simulate --methods neuro,linear,opencv --random-starts 0 --json
      neurocal calibrate sample_data/flat.csv --no-skew -o camera.yaml
      neurocal simulate --camera camera.yaml --sigma 0.1 --trials 5 \\
          --random-starts 0 --seed 1
      echo "planes: [{name: board, cols: 9, rows: 6, square: 25}]" > board.yaml
      neurocal simulate --camera camera.yaml --board board.yaml --views 4 \\
          --sigma 0.2 --trials 2 --random-starts 2 --save simulated --images --jobs 1
      neurocal simulate --rig ring:8 --views 80 --sigma 0.3 --trials 2 --save ring
      neurocal simulate --rates --data-sets 1
    """  # noqa: D301 - as in the group
    if rates:
        options.note_unused("with --rates", "sigma", "trials", "methods", "random_starts")
    else:
        options.note_unused("without --rates", "data_sets")
    if images and save is None:
        raise UsageError("--images needs a place to write to; give --save DIR")
    if rates and (save, camera, board, views) != (None,) * 4:
        raise UsageError("--rates makes its own data sets; leave out --camera, --board, --views and --save")
    if save is not None:
        preparation.check_folder("--save", save)
    preparation.check((camera, board), plots=plots)
    if rig is not None:
        if rates or (camera, board) != (None,) * 2 or plots or images:
            raise UsageError(
                "--rig makes its own cameras and board; leave out --camera, --board, --images, --plot, "
                "--rates"
            )
        options.note_unused("with --rig", "methods", "random_starts", "jobs")
        _rig(rig, views, sorted(set(sigma)), trials, seed, save, as_json)
        return

    from neurocal_cli.files.processes import usable_cores

    jobs = jobs or usable_cores()
    from neurocal_cli.commands.show import methods_report as show

    if rates:
        from neurocal_cli.simulation.starts import study_rates

        with ProgressBar() as progress:
            found = study_rates(data_sets, seed, jobs, progress)
        show.rates_report(found).print(as_json)
        write_plots(plots, show.draw_rates, found)
        return
    scene, paper = _scene(camera, board, views, seed), (camera, board, views) == (None,) * 3
    levels = sorted(set(sigma))
    if save is not None:
        _save(scene, save, levels, seed, images)
    from neurocal_cli.simulation.comparison import study_noise

    with ProgressBar() as progress:
        study = study_noise(scene, levels, trials, methods, seed, jobs, progress)
        starts = _starts(scene, random_starts, seed, jobs, progress)
    show.simulation_report(scene, seed, study, starts, paper).print(as_json)
    write_plots(plots, show.draw_simulation, study, starts, scene.unit)


def _scene(camera_file: str | None, board_file: str | None, views: int | None, seed: int) -> SimulatedScene:
    """The scene; without options, that of the paper."""
    import numpy as np

    from neurocal_cli.simulation import scenes

    if camera_file is None and board_file is None and views is None:
        return scenes.paper_scene()
    camera, board = scenes.PAPER_CAMERA, scenes.PAPER_BOARD
    if board_file is not None:
        board = boards.named_board(board_file)
    if camera_file is not None:
        from neurocal_cli.camera.camera import camera_of
        from neurocal_cli.files.calibration_yaml import read_calibration

        own = board_file is None and views is None
        if own:
            with suppress(FormatError):
                return scenes.calibrated_scene(read_calibration(camera_file))
        camera = camera_of(preparation.known_camera(camera_file))
        if own:
            note(f"{camera_file} holds no points of its own; the paper's boards are used")
    count = views or (_FLAT_VIEWS if len(board.planes) == 1 else 1)
    poses = scenes.random_poses(camera, board, count, np.random.default_rng((seed, 2)))
    return scenes.scene_of(camera, board, poses)


def _starts(
    scene: SimulatedScene, count: int, seed: int, jobs: int, progress: ProgressBar
) -> StartStudy | None:
    """The study of random starts; None without any, or if the points do not determine a camera."""
    from neurocal_cli.simulation.starts import study_starts

    if not count:
        return None
    try:
        return study_starts(scene, _STARTS_SIGMA, count, seed, jobs, progress)
    except DegenerateGeometryError as error:
        note(f"no random starts: {error}")
        return None


def _rig(
    words: str,
    views: int | None,
    levels: list[float],
    trials: int,
    seed: int,
    save: str | None,
    as_json: bool,
) -> None:
    """Study a rig of many cameras, and write its points, those of the first trial, and its poses."""
    layout, _, count = words.partition(":")
    if not count.isdecimal() or not 2 <= int(count) <= _MOST_CAMERAS:
        raise UsageError(f"--rig {words}: give the layout and the number of cameras, such as ring:8")
    import numpy as np

    from neurocal_cli.commands.show.methods_report import rig_study_report
    from neurocal_cli.simulation.rigs import study_rig

    with ProgressBar() as progress:
        study = study_rig(layout, int(count), views or _RIG_FRAMES, levels, trials, seed, progress)
    report = rig_study_report(study)
    if save is not None:
        from neurocal_cli.files.points_csv import write_points

        make_folder(save)
        truth = {"unit": "mm", "poses": report.tree["poses"]}
        write_whole(os.path.join(save, "truth.json"), json.dumps(truth, indent=2) + "\n")
        for k, level in enumerate(levels):
            for name, points in study.rig.points(level, np.random.default_rng((seed, k, 0))).items():
                file = f"sigma_{str(level).removesuffix('.0')}_{name}.csv"
                write_points(points, os.path.join(save, file))
    report.print(as_json)


def _save(scene: SimulatedScene, folder: str, levels: list[float], seed: int, images: bool) -> None:
    """Write the truth and the data simulated from it; the noisy points are those of the first trial."""
    import numpy as np

    from neurocal_cli.files.board_yaml import write_board
    from neurocal_cli.files.points_csv import write_points
    from neurocal_cli.files.result_files import write_calibration
    from neurocal_cli.simulation.scenes import true_calibration

    make_folder(folder)
    write_calibration(true_calibration(scene), os.path.join(folder, "truth.yaml"))
    write_points(scene.points(), os.path.join(folder, "exact.csv"))
    for k, level in enumerate(levels):
        points = scene.points(level, np.random.default_rng((seed, k, 0)))
        name = str(level).removesuffix(".0")  # all digits, so that no two levels share a file
        write_points(points, os.path.join(folder, f"sigma_{name}.csv"))
    if scene.board is not None:
        write_board(scene.board, os.path.join(folder, "board.yaml"))
    if images:
        from neurocal_cli.files.images import encode_png
        from neurocal_cli.simulation.scenes import pictures, visible_points

        drawn = list(pictures(scene, seed))
        for one in drawn:
            write_whole(os.path.join(folder, f"{one.name}.png"), encode_png(one.image))
        write_points(visible_points(scene, drawn), os.path.join(folder, "visible.csv"))
