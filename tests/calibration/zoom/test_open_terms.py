"""The std of a zoom lens hold where its networks took a bend for a straight line."""

from __future__ import annotations

import numpy as np
import pytest
from support.zoom_laws import between, boards, grid, over_std, seen

from neurocal import fit_lens
from neurocal_cli.adjustment.cross_validation import Quadratics
from neurocal_cli.calibration.zoom import open_terms
from neurocal_cli.calibration.zoom.mlfn import Topology
from neurocal_cli.calibration.zoom.open_terms import OpenNets
from neurocal_cli.calibration.zoom.parameter_networks import LensNets, ParameterNet
from neurocal_cli.calibration.zoom.settings import QuadraticError
from neurocal_cli.camera.geometry import Array

ZOOMS = np.linspace(-1, 1, 6)[:, None]
NOISE = 0.2


def straight(y: Array) -> LensNets:
    """Networks of four parameters that are constant but the last one, a line through its values (S,)."""
    topology = Topology(1, 0, 0)
    precision = np.full(topology.n_groups, 1e8)  # of all weights but the plane's
    slope, constant = np.polyfit(ZOOMS[:, 0], y, 1)
    weights = np.zeros(topology.n_weights)
    weights[topology.parts["q"]], weights[topology.parts["o"]] = [slope, 0.0], constant
    still = np.zeros(topology.n_weights)
    nets = [ParameterNet(topology, still, precision, 800.0, 1.0)]
    nets += [ParameterNet(topology, w, precision, 0.0, 1.0) for w in (still, still, weights)]
    return LensNets("linear", tuple(nets))


def spread_at(nets: LensNets, y: Array, x: Array) -> Array:
    """(n,) variance of the last parameter at scaled controls, whose values (S,) have the noise of NOISE."""
    local = nets.local(ZOOMS)
    local[:, 3] = y
    S, L = local.shape
    normal = Quadratics(np.tile(np.eye(L) / NOISE**2, (S, 1, 1)), np.zeros((S, L)), np.zeros(S))
    opened = OpenNets.of(nets, ZOOMS)
    covariance = opened.posterior(QuadraticError(ZOOMS, local, normal, 1.0))
    J = opened.local_with_jacobian(x)[1][:, 3]
    return np.einsum("np,pq,nq->n", J, covariance, J)


def test_bends_of_every_size_are_within_the_std_of_a_straight_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Parameters drawn from the priors, so that the mean of the squared error over the variance is 1."""
    rng, x = np.random.default_rng(1), np.linspace(-1, 1, 11)[:, None]
    powers = x ** np.arange(4)
    odds = np.array([1.0, *open_terms._ODDS.values()])
    ratios, without = [], []
    for _ in range(400):
        size = rng.choice([0.0, *open_terms._ODDS], p=odds / odds.sum())
        true = powers @ (rng.normal(size=4) * [1.0, 1.0, size, size])
        y = true[::2] + NOISE * rng.normal(size=6)
        nets = straight(y)
        squares = (nets.local(x)[:, 3] - true) ** 2
        ratios.append(squares / spread_at(nets, y, x))
        with monkeypatch.context() as closed:
            closed.setattr(open_terms, "_DEGREE", 1)
            without.append(squares / spread_at(nets, y, x))
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.25)
    assert np.mean(without) > 10


def test_the_terms_are_those_that_the_settings_determine() -> None:
    nets = straight(np.zeros(6))
    nodes = np.array([(z, f) for z in (-1.0, 0.0, 1.0) for f in (-1.0, 1.0)])
    assert OpenNets.of(nets, ZOOMS).powers.tolist() == [[2], [3]]
    assert OpenNets.of(nets, ZOOMS[[0, 2, 5]]).powers.tolist() == [[2]]
    assert OpenNets.of(nets, nodes).powers.tolist() == [[1, 1], [2, 0], [2, 1]]
    assert not len(OpenNets.of(nets, ZOOMS[[0, 5]]).powers)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "views"), [("f", 4), ("c", 4), ("d", 3)])
def test_the_std_of_lenses_that_bend_by_little_hold(law: str, views: int) -> None:
    """Moving boards: the noise of a setting is near what the centre bends by."""
    good, errors = 0, []
    for seed in range(12):
        points = boards(law, grid(5, 3), views, seed=60000 + seed)
        lens = fit_lens(points, distortion="none", target="given", skew=False)
        there = [over_std(lens, law, settings) for settings in (lens.settings, between(5, 3))]
        errors.append(np.concatenate(there))
        if lens.verdict.word == "good":
            good += 1
            assert np.abs(errors[-1]).max() < 4
    assert good >= 9
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    assert (rms > 0.6).all()
    assert (rms < 1.2).all()


@pytest.mark.slow
def test_the_std_contain_the_laws_that_four_zooms_leave_open() -> None:
    """A hyperbola would pass for the cosine of the centre."""
    for seed in range(90000, 90004):
        lens = fit_lens(seen("a", grid(4, 4), seed), distortion="none")
        assert lens.verdict.word == "good"
        assert np.abs(over_std(lens, "a", between(4, 4))[:, :4]).max() < 3.0
