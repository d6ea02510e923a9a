"""What a fit that begins at a scene's truth ends with: what the points can tell, and the lowest error."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.problem import Problem, normalised, problem_for
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.lens_choice.candidate_models import fit_candidates
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences
from support.campaign import Truth


@dataclass(frozen=True, eq=False)
class Reference:
    """A fit of the true model from the truth.

    Attributes
    ----------
    truth : Truth
    share : float
        Standard deviation of alpha_u, over alpha_u.
    """

    truth: Truth
    share: float

    def excess(self, found: Calibration) -> float:
        """Squared error of a calibration over the one that the same model reaches from the truth."""
        points, model = found.points, found.camera.distortion.model
        problem, start = _at_the_truth(points, self.truth)
        candidates = fit_candidates(problem, start, by_views=False)
        reached = candidates.get(model)
        if reached is None:
            return 1.0
        return float(found.rmse_px**2 * len(points) / (reached.cost * problem.views.pixel_scale**2))


def reference(points: Correspondences, truth: Truth) -> Reference:
    problem, start = _at_the_truth(points, truth)
    best: Adjusted = problem.adjust(start, 300)
    spread = np.inf
    if truth.condition != "outliers":
        normal = best.normal
    else:  # the noise without them
        normal = best.normal.copy()
        normal[:, -1, -1] = 2 * problem.views.counts * (truth.sigma / problem.views.pixel_scale) ** 2
    cov = problem.minimum(replace(best, normal=normal)).covariance(problem.views.n_equations)
    spread = float(np.sqrt(cov.shared[0, 0]) / best.state.entries[0, 0])
    return Reference(truth, spread if np.isfinite(spread) else np.inf)


def _at_the_truth(points: Correspondences, truth: Truth) -> tuple[Problem, CameraState]:
    problem = problem_for(points, 1, distortion=Distortion(truth.model))
    place = [int(name[1:]) for name in problem.views.names]
    known = CameraState(
        truth.A[ENTRIES][None], truth.R[place], truth.t[place], truth.model, np.array(truth.k)
    )
    return problem, normalised(known, problem.views)
