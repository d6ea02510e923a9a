"""How a calibration is computed: what trains the networks, from how many starts, and what is tried."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.training import Task, Trained, Trainer
from neurocal_cli.training.levenberg_marquardt import LMOptions, train_lm
from neurocal_cli.training.starts import Agreement

if TYPE_CHECKING:
    from neurocal_cli.training.backprop import BackpropOptions

# Of each view, that a network sees: beyond it nothing changes but the time (tests/test_convergence.py).
MOST_POINTS = 1024

# Called with the name of a stage and the share of it that is done.
Progress = Callable[[str, float], None]


@frozen_dataclass
class Options:
    """How networks are trained, and how the distortion is found.

    Attributes
    ----------
    trainer : Trainer
        Takes random starts to their minimum.
    agreement : Agreement
        When two starts count as one result.
    start_points : (int, int)
        Points of each view that the starts see, for flat and for solid targets.
    finish : Trainer or None
        Takes the best start on to `MOST_POINTS`; None when the starts saw them.
    starts : int
        Most random starts for each network.
    constrained : callable or None
        Trains on E_tot, eq. (14), with some weights fixed, given the task and the constant a; None
        where bundle adjustment alone imposes the constraints.
    distortion : str
        "auto": choose the model; "plumb-line": find it from straight lines first; else as the problem says.
    preferred : str
        With "auto", a model to take where no other predicts decidedly better.
    seed : int
        Of the random weights.
    progress : callable
    """

    trainer: Trainer
    agreement: Agreement
    start_points: tuple[int, int]
    finish: Trainer | None
    starts: int
    constrained: Callable[[Task, float], Trained] | None = None
    distortion: str = ""
    preferred: str = ""
    seed: int = 0
    progress: Progress = lambda stage, share: None


def options_for(
    trainer: str,
    starts: int,
    seed: int,
    *,
    distortion: str = "",
    preferred: str = "",
    backprop: BackpropOptions | None = None,
    progress: Progress | None = None,
) -> Options:
    """Options of a trainer: "lm", Levenberg-Marquardt, or "backprop", the paper's learning rule.

    Starts see a few points of each view, as many as make their minimum that of all points; the best
    goes on to `MOST_POINTS`.
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
    from neurocal_cli.training.backprop import BackpropOptions, train_backprop

    rates = backprop or BackpropOptions()

    def train(task: Task) -> Trained:
        return train_backprop(task, rates, lambda share: report("training the networks", share))

    def constrained(task: Task, a: float) -> Trained:
        # Lower rates than from random weights, and every gamma where it belongs: it starts trained.
        gentle = replace(rates, rate_weights=0.4 * rates.rate_weights, beta=10.0, a=a, resting_gamma=True)
        return train_backprop(task, gentle, lambda share: report("training with orthogonality", share))

    return options(
        trainer=train,
        agreement=Agreement(0.02, 1e-4),
        start_points=(MOST_POINTS, MOST_POINTS),
        finish=None,
        constrained=constrained,
    )
