"""Uncertainty of a zoom lens from terms of its laws that the networks left out.

The priors of a network's weights come from the data. Where a parameter bends by little, its network is taken
as straight, and the posterior of its weights no longer contains a bend. Therefore the terms of the second and
third degree in the controls are open, in addition to each network: x^2 and x^3 of each control, and products.
They are absent (0) or have a Gaussian prior, and the data tell how probable each is, as for coefficients that
a distortion model leaves out (`adjustment.open_choices`). To second order around the trained weights, all
follow from one normal matrix. The reported lens stays as it is. Where a network bends by itself, its weights
take in an open term, and nothing is added.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead
from neurocal_cli.adjustment.open_choices import OpenPrior, spread_of_open
from neurocal_cli.calibration.zoom.parameter_networks import LensNets
from neurocal_cli.calibration.zoom.settings import QuadraticError, inverse
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_DEGREE = 3  # the highest one
# Prior odds of the terms over their absence, by their size as a share of the parameter's spread over the
# settings. With them, the errors over std of test_the_std_of_lenses_that_bend_by_little_hold (slow) hold.
_ODDS = {0.1: 1.0, 0.3: 1.0, 1.0: 1.0, 3.0: 1.0}


@frozen_dataclass(eq=False)
class OpenNets:
    """Networks with open terms, whose coefficients are 0: a `settings.LinearisedModel`."""

    nets: LensNets
    powers: Array  # (K, D) of the controls in each term

    @classmethod
    def of(cls, nets: LensNets, nodes: Array) -> OpenNets:
        """With the terms that settings at scaled controls (S, D) determine."""
        powers = powers_up_to(nodes, _DEGREE)
        return cls(nets, powers[powers.sum(axis=1) > 1])

    @property
    def _none(self) -> Array:
        return np.zeros(len(self.nets.nets) * len(self.powers))

    @property
    def weights(self) -> Array:
        """(P + L K,) of the networks, and the coefficients of each network's terms."""
        return np.concatenate([self.nets.weights, self._none])

    @property
    def prior(self) -> Array:
        """(P + L K,) precisions of the networks' weights; 0 for the coefficients."""
        return np.concatenate([self.nets.prior, self._none])

    def local_with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Local parameters (n, L), and their derivatives by weights and coefficients (n, L, P + L K)."""
        local, J = self.nets.local_with_jacobian(x)
        constant = np.cumsum([net.topology.n_weights for net in self.nets.nets]) - 1  # o is the last weight
        terms = J[:, :, constant, None] * monomials(x, self.powers)[:, None, None]
        return local, np.concatenate([J, terms.reshape(*local.shape, -1)], axis=2)

    def posterior(self, error: QuadraticError) -> Array:
        """Covariance of weights, coefficients and constants (P + L K + Q, ...), averaged over the priors.

        The terms of one network at a time are open.
        """
        P, n = len(self.nets.weights), len(self._none)
        N, rhs = error.system(self, np.zeros(error.normal.S.shape[1] - len(self.nets.nets)))
        estimated = np.r_[:P, P + n : len(N)]
        covariance = np.zeros_like(N)
        covariance[np.ix_(estimated, estimated)] = inverse(N[np.ix_(estimated, estimated)])
        if not n:
            return covariance
        for own in np.arange(P, P + n).reshape(-1, len(self.powers)):
            some = np.sort(np.append(estimated, own))
            place = np.ix_(some, some)
            arrow = Arrowhead.alone(N[place], rhs[some], 0.0)
            spread = spread_of_open(arrow, 1.0, self._prior(np.isin(some, own)))
            if spread is not None:
                covariance[place] += spread.follow @ spread.E @ spread.follow.T
        return covariance

    def _prior(self, is_open: NDArray[np.bool_]) -> OpenPrior:
        """Of the terms of one network; those of the same controls are present or absent together."""
        K, controls = len(self.powers), self.powers > 0
        groups = [np.flatnonzero((controls == kind).all(axis=1)) for kind in np.unique(controls, axis=0)]
        return OpenPrior(is_open, is_open, np.zeros(K), np.ones(K), tuple(groups), (_ODDS,) * len(groups))


def powers_up_to(nodes: Array, degree: int) -> Array:
    """Powers of the controls (K, D) up to a total degree that the values of the settings (S, D) determine."""
    most = [len(np.unique(column)) - 1 for column in nodes.T]
    powers = np.array(list(product(*(range(min(limit, degree) + 1) for limit in most))))
    return np.asarray(powers[powers.sum(axis=1) <= degree])


def monomials(x: Array, powers: Array) -> Array:
    """Products of powers (K, D) of the controls (n, D); (n, K)."""
    return np.asarray(np.prod(x[:, None] ** powers, axis=2))
