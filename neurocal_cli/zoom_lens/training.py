"""Steps 2 and 3 of a lens: a network for each parameter, then all of them with the calibrating net."""

from __future__ import annotations

import numpy as np

from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.zoom_lens.alternating_training import train_alternating
from neurocal_cli.zoom_lens.committee import Budget, fit_committee
from neurocal_cli.zoom_lens.cross_validation import LeftOut, left_out_errors
from neurocal_cli.zoom_lens.initialisation import Options, Progress, Start
from neurocal_cli.zoom_lens.joint_training import Joint, train_joint
from neurocal_cli.zoom_lens.parameter_networks import LensNets, to_scale
from neurocal_cli.zoom_lens.static_calibration import Tables

__all__ = ["errors_left_out", "scatter_of", "train_all"]


def train_all(start: Start, options: Options, budget: Budget, report: Progress) -> list[Joint]:
    """Steps 2 and 3; the members of highest evidence first."""
    x, rng = start.controls, np.random.default_rng(options.seed)
    members = fit_committee(
        x,
        start.data.names,
        start.tables.local,
        start.tables.normal,
        start.variance,
        rng,
        budget,
        lambda share: report("fitting a network to each parameter", share),
    )
    train = train_joint if options.training == "joint" else train_alternating
    # A lens that does not return to its place shows it to every network; one that cannot follow is alone.
    scatter = np.min([scatter_of(nets, start.tables) for nets in members], axis=0)
    joints = []
    for k, nets in enumerate(members):

        def tell(share: float, k: int = k) -> None:
            report("all networks together", (k + share) / len(members))

        joints.append(train(start.data, x, nets, start.tables.constants, start.variance, scatter, tell))
    joints = [joint for joint in joints if np.isfinite(joint.evidence)]
    if not joints:
        raise DegenerateGeometryError(
            f"{start.lens.points.source}: no network fits the settings; give more settings"
        )
    joints.sort(key=lambda joint: -joint.evidence)
    return joints


def scatter_of(nets: LensNets, tables: Tables) -> Array:
    """(L,) variance of the local parameters from setting to setting, from that of the outputs."""
    scatter = np.array([net.scatter for net in nets.nets])
    alpha = np.median(tables.local[:, :2], axis=0)
    slope = float(np.median(np.abs(to_scale(nets.scale, tables.local[:, 0])[1])))
    scatter[0] /= slope**2
    scatter[1] = scatter[1] * alpha[1] ** 2 + scatter[0]
    return scatter


def errors_left_out(start: Start, joint: Joint) -> LeftOut:
    """Errors at each setting when it is left out of the networks."""
    scatter = scatter_of(joint.nets, start.tables)
    return left_out_errors(start.controls, joint, start.tables, start.variance, scatter)
