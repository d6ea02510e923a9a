"""Steps 2 and 3: a network for each parameter, then training of all networks together."""

from __future__ import annotations

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.zoom_lens.alternating_training import take_turns
from neurocal_cli.zoom_lens.committee import fit_committee
from neurocal_cli.zoom_lens.initialisation import CalibratedSettings, FitOptions
from neurocal_cli.zoom_lens.joint_training import Joint, train_joint


def train_all(start: CalibratedSettings, options: FitOptions) -> list[Joint]:
    """Steps 2 and 3. The members come in descending order of their evidence."""
    x, rng = start.controls, np.random.default_rng(options.seed)
    members = fit_committee(
        x,
        start.data.names,
        start.tables.local,
        start.tables.normal.H,
        start.variance,
        rng,
        options.budget,
        lambda share: options.report("fitting a network to each parameter", share),
    )
    descend = None if options.training == "joint" else take_turns
    # Every network fits the scatter of a lens that does not repeat its positions. A poor network alone fits
    # more, so the smallest value counts.
    scatter = np.min([nets.local_scatter(start.tables.local) for nets in members], axis=0)
    joints = []
    for k, nets in enumerate(members):

        def report_share(share: float, k: int = k) -> None:
            options.report("all networks together", (k + share) / len(members))

        arguments = start.data, x, nets, start.tables.constants, start.variance, scatter
        joints.append(train_joint(*arguments, report_share, descend))
    joints = [joint for joint in joints if np.isfinite(joint.evidence)]
    if not joints:
        raise DegenerateGeometryError(
            f"{start.lens.points.source}: no network fits the settings; give more settings"
        )
    joints.sort(key=lambda joint: -joint.evidence)
    return joints
