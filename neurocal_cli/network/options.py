"""Options of a calibration: the trainer of the networks, the number of starts, the distortion selection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.network.levenberg_marquardt import LMOptions, train_lm
from neurocal_cli.network.network import Task, Trained, Trainer
from neurocal_cli.network.starts import Agreement

if TYPE_CHECKING:
    from neurocal_cli.network.backprop import BackpropOptions

# Most points of each view that train a network; more only take longer (test_convergence.py).
MOST_POINTS = 1024

STARTS = 20
"""Most random starts for each network."""

# Called with the name of a stage and the completed share of it.
Progress = Callable[[str, float], None]


@frozen_dataclass
class Options:
    """How networks are trained, and how the distortion is found."""

    trainer: Trainer  # trains random starts to their minimum
    agreement: Agreement  # tolerance within which two starts have the same result
    # Points of each view on which the starts are trained, for flat and for solid targets.
    start_points: tuple[int, int]
    # Trains the best start on `MOST_POINTS` points; None if the starts used them already.
    finish: Trainer | None
    starts: int  # most random starts for each network
    # "auto": select the model; "plumb-line": estimate it from straight lines first; else the problem's.
    distortion: str
    preferred: str  # with "auto", the model to select unless another predicts decidedly better
    seed: int  # of the random weights
    progress: Progress
    # Trains on E_tot, eq. (14), with some weights fixed, given the task and the constant a; None if bundle
    # adjustment alone imposes the constraints.
    constrained: Callable[[Task, float], Trained] | None = None


def options_for(
    trainer: str,
    starts: int = STARTS,
    seed: int = 0,
    *,
    distortion: str = "",
    preferred: str = "",
    backprop: BackpropOptions | None = None,
    progress: Progress | None = None,
) -> Options:
    """Options of a trainer: "lm", Levenberg-Marquardt, or "backprop", the paper's learning rule.

    Starts are trained on a few points of each view, enough for their minimum to be that of all points; the
    best start is then trained on `MOST_POINTS`.
    """
    report = progress or (lambda stage, share: None)
    options = partial(
        Options, starts=starts, distortion=distortion, preferred=preferred, seed=seed, progress=report
    )
    if trainer == "lm":
        begin = LMOptions(tolerance=1e-4)
        finish = LMOptions(stiffness=(0.0,), tolerance=1e-2, damping=1e-8)
        return options(
            trainer=lambda task: train_lm(task, begin),
            agreement=Agreement(),
            start_points=(16, 40),
            finish=lambda task: train_lm(task, finish),
        )
    from neurocal_cli.network.backprop import BackpropOptions, train_backprop

    rates = backprop or BackpropOptions()

    def train(task: Task) -> Trained:
        return train_backprop(task, rates, lambda share: report("training the networks", share))

    def constrained(task: Task, a: float) -> Trained:
        # It starts from trained weights: lower rates, and every gamma at its optimum.
        gentle = replace(rates, rate_weights=0.4 * rates.rate_weights, beta=10.0, a=a, resting_gamma=True)
        return train_backprop(task, gentle, lambda share: report("training with orthogonality", share))

    return options(
        trainer=train,
        agreement=Agreement(0.02, 1e-4),
        start_points=(MOST_POINTS, MOST_POINTS),
        finish=None,
        constrained=constrained,
    )
