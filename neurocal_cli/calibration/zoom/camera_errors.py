"""Errors of known cameras, whose size nobody tells, from the networks that follow them.

A network may pass through all cameras, and then its residuals say nothing. By the priors of its weights, it
is a sum of independent functions of the setting, the eigenvectors of J P^-1 J^T with the eigenvalues w_k as
variances: a constant, a slope, a bend, and ever finer wiggles, whose variances fall quickly. So the targets'
parts t_k along the finest functions are errors for the most part:

    sigma^2 = sum_k q_k t_k^2 / sum_k q_k,   q_k = 1 / (w_k + tau^2)^2,   nu = (sum_k q_k)^2 / sum_k q_k^2

tau^2 is raised from the scatter that the training found until nu degrees of freedom count, because one wiggle
alone may be 0 by chance. What the parts hold of the lens itself makes sigma too large, never too small.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurocal_cli.calibration.zoom.parameter_networks import LensNets, ParameterNet, from_scale
from neurocal_cli.camera.geometry import Array

_LEAST_STD = 1e-6  # of a parameter without errors, as a share of the parameter
# Degrees of freedom that must count: two of five cameras with one control, four of seven or more. Repeated by
# test_the_errors_of_known_cameras_are_told (slow).
_LEAST_FREEDOM, _ENOUGH_FREEDOM = 2.0, 4.0
_SMOOTH = 3  # weights for each control of a smooth parameter
_TAU2 = 1e-8 * 10 ** np.arange(0.0, 9.0, 0.125)
# Limit of a deletion residual with many degrees of freedom, and how it grows with few: none of 120 good
# tables exceeds it. Repeated by the same test.
_ODD, _ODD_GROWTH = 6.0, 10.0


def too_few(cameras: int, controls: int) -> bool:
    """Whether the cameras are too few to tell their errors from the lens."""
    return cameras - _SMOOTH * controls < _LEAST_FREEDOM


def error_variances(members: Sequence[LensNets], x: Array, outputs: Array) -> Array:
    """Variances (S, L) of the errors of the networks' targets `outputs` (S, L) at scaled controls x (S, D).

    The errors of alpha_u are taken to be equal shares of it. u0 and v0 are taken to have equal errors, so
    that two parameters tell their size.
    """
    variances = np.median(_errors(members, x, outputs)[0], axis=0)
    variances[2:4] = variances[2:4].mean()
    return np.asarray(variances * _sizes(members[0].scale, outputs) ** 2)


def odd_camera(members: Sequence[LensNets], x: Array, outputs: Array) -> int | None:
    """The camera whose deletion makes all others agree far better, or None; see `error_variances`."""
    S = len(x)
    if too_few(S, x.shape[1]):
        return None
    variance, freedom = _errors(members, x, outputs)
    excess = np.zeros(S)
    for s in range(S):
        rest = np.arange(S) != s
        without, left = _errors(members, x[rest], outputs[rest])
        squares = (freedom * variance - left * without) / without
        excess[s] = np.median(np.sqrt(np.maximum(squares, 0)) / (1 + _ODD_GROWTH / left**2), axis=0).max()
    worst = int(excess.argmax())
    return worst if excess[worst] > _ODD else None


def _errors(members: Sequence[LensNets], x: Array, outputs: Array) -> tuple[Array, Array]:
    """sigma^2 and nu (M, L) of each network."""
    sizes = _sizes(members[0].scale, outputs)
    found = np.array(
        [
            [_error(net, x, *of) for net, *of in zip(nets.nets, outputs.T, sizes.T, strict=True)]
            for nets in members
        ]
    )
    size = np.abs(np.median(outputs, axis=0))
    size[1] = 1.0  # log(alpha_v / alpha_u): a ratio of 1 is 0
    return np.maximum(found[..., 0], (_LEAST_STD * size) ** 2), found[..., 1]


def _error(net: ParameterNet, x: Array, targets: Array, sizes: Array) -> tuple[float, float]:
    """sigma^2 and nu of one network, for targets whose errors have relative sizes."""
    y, J = net.output_with_jacobian(x)
    J = J / (net.spread * sizes[:, None])
    w, functions = np.linalg.eigh((J / net.prior) @ J.T)  # P: the precisions of the prior
    # The weights' prior is about 0, so only the network without its linear part is subtracted.
    parts = functions.T @ ((targets - y) / (net.spread * sizes) + J @ net.weights)
    S, D = x.shape
    wanted = np.clip(S - _SMOOTH * D, min(_LEAST_FREEDOM, S - 2), _ENOUGH_FREEDOM)
    tau2 = np.maximum(_TAU2, net.scatter / net.spread**2)
    q = 1 / (np.maximum(w, 0.0) + tau2[:, None]) ** 2
    freedom = q.sum(axis=1) ** 2 / (q * q).sum(axis=1)
    k = min(int((freedom < wanted).sum()), len(tau2) - 1)
    return float((q[k] * parts**2).sum() / q[k].sum()) * net.spread**2, float(freedom[k])


def _sizes(scale: str, outputs: Array) -> Array:
    """Relative sizes (S, L) of the targets' errors, with a mean square of 1."""
    sizes = np.ones_like(outputs)
    alpha, derivative = from_scale(scale, outputs[:, 0])
    sizes[:, 0] = np.abs(alpha / derivative)
    return sizes / np.sqrt((sizes**2).mean(axis=0))
