"""Random starts: repeated until two agree, and never more than allowed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.network.network import Patterns, Task, Trained
from neurocal_cli.network.starts import Agreement, Learnt, learn

K, N = 3, 8


def patterns(n_views: int = K) -> Patterns:
    rng = np.random.default_rng(0)
    inputs = np.concatenate([rng.uniform(-1, 1, (n_views, N, 3)), np.ones((n_views, N, 1))], axis=2)
    targets = np.concatenate([rng.uniform(-1, 1, (n_views, N, 2)), np.ones((n_views, N, 1))], axis=2)
    return Patterns(inputs, targets, np.ones((n_views, N)))


class Script:
    """A trainer that hands out losses from a list for each view, and notes what it was asked."""

    def __init__(self, losses: list[list[float]], behind: tuple[tuple[int, int], ...] = ()) -> None:
        self.losses, self.behind = losses, behind
        self.given = [0] * len(losses)
        self.tasks: list[Task] = []
        self.first = patterns(len(losses)).inputs[:, 0, 0]

    def __call__(self, task: Task) -> Trained:
        self.tasks.append(task)
        G = len(task.W)
        loss, V = np.empty(G), np.zeros((G, 3, 4))
        V[:, 2, 3] = 1.0  # all points at depth 1
        for g in range(G):
            view = int(np.flatnonzero(self.first == task.patterns.inputs[g, 0, 0])[0])
            n = self.given[view]
            self.given[view] += 1
            loss[g] = self.losses[view][n]
            if (view, n) in self.behind:
                V[g, 2] = [100.0, 0.0, 0.0, 0.0]  # depth of the sign of X
            V[g, 0, 0] = n  # which start it was
        ones: NDArray[np.int64] = np.ones(G, dtype=np.int64)
        curve: Array = np.stack([2 * loss, loss])
        W = np.tile(np.eye(3), (G, 1, 1))
        return Trained(W, V, np.ones((G, N)), loss, ones, ones > 0, curve)


def run(script: Script, limit: int = 20, **more: object) -> Learnt:
    return learn(patterns(len(script.losses)), script, np.random.default_rng(0), limit, **more)  # type: ignore[arg-type]


def test_two_starts_that_agree_are_enough() -> None:
    learnt = run(Script([[1.0, 1.0], [2.0, 2.0], [0.5, 0.5]]))
    assert learnt.starts.tolist() == [2, 2, 2]
    assert learnt.agreed.tolist() == [2, 2, 2]
    np.testing.assert_allclose(learnt.rms, np.sqrt(2 * np.array([1.0, 2.0, 0.5]) / N))


def test_only_views_without_agreement_go_on_and_the_best_of_them_is_kept() -> None:
    learnt = run(Script([[1.0, 1.0], [9.0, 5.0, 7.0, 1.0, 1.0, 8.0], [3.0, 3.0]]))
    assert learnt.starts.tolist() == [2, 6, 2]
    assert learnt.agreed.tolist() == [2, 2, 2]
    assert learnt.V[1, 0, 0] == 3  # the first of the two at the lowest loss
    assert learnt.iterations == 10


def test_agreement_at_a_worse_loss_does_not_count_once_a_better_one_is_known() -> None:
    learnt = run(Script([[5.0, 1.0, 5.0, 5.0, 5.0, 5.0, 1.0, 5.0, 5.0, 5.0]]))
    assert learnt.starts.tolist() == [10]
    assert learnt.agreed.tolist() == [2]
    assert learnt.rms[0] == pytest.approx(np.sqrt(2 / N))


def test_starts_end_at_the_limit_and_the_record_says_how_many_agreed() -> None:
    learnt = run(Script([[float(n) for n in range(30, 0, -1)]]), limit=7)
    assert learnt.starts.tolist() == [7]
    assert learnt.agreed.tolist() == [1]
    assert learnt.V[0, 0, 0] == 6


def test_points_on_both_sides_of_the_camera_lose_to_any_that_are_not() -> None:
    learnt = run(Script([[0.1, 0.1, 4.0, 4.0, 9.0, 9.0]], behind=((0, 0), (0, 1))))
    assert learnt.starts.tolist() == [6]
    assert learnt.V[0, 0, 0] == 2  # the first with all points on one side
    assert learnt.rms[0] == pytest.approx(np.sqrt(2 * 4 / N))


def test_how_near_two_losses_must_be() -> None:
    near, far = [1.0, 1.0 + 1e-4, *[9.0, 8.0, 7.0, 6.0]], [1.0, 1.001, *[9.0, 8.0, 7.0, 6.0]]
    assert run(Script([near]), limit=6).starts.tolist() == [2]
    assert run(Script([far]), limit=6).starts.tolist() == [6]
    assert run(Script([far]), limit=6, agreement=Agreement(relative=0.01)).starts.tolist() == [2]


def test_losses_of_rounding_agree() -> None:
    assert run(Script([[1e-28, 3e-25]])).agreed.tolist() == [2]


def test_a_loss_that_is_nan_never_wins() -> None:
    learnt = run(Script([[np.nan, 2.0, np.nan, 2.0, 3.0, 4.0]]))
    assert learnt.agreed.tolist() == [2]
    assert learnt.V[0, 0, 0] == 1


def test_the_curve_is_that_of_the_first_views_best_start() -> None:
    learnt = run(Script([[9.0, 5.0, 1.0, 7.0, 1.0, 8.0], [3.0, 3.0]]))
    np.testing.assert_allclose(learnt.curve, np.sqrt(2 * np.array([2.0, 1.0]) / N))


def test_given_weights_are_the_same_in_every_start_and_not_free() -> None:
    W = np.full((3, 3), np.nan)
    W[:2, 2] = 0.25
    script = Script([[1.0, 2.0, 3.0, 3.0, 3.0, 1.0]])
    run(script, W=W)
    for task in script.tasks:
        assert (task.W[:, :2, 2] == 0.25).all()
        assert task.free_W.tolist() == np.isnan(W).tolist()
        assert task.free_V.all()
    drawn = np.concatenate([task.W[:, 0, 0] for task in script.tasks])
    assert len(set(drawn)) == len(drawn)


def test_a_given_pose_is_not_free() -> None:
    V = np.random.default_rng(0).normal(size=(1, 3, 4))
    script = Script([[1.0, 1.0]])
    run(script, V=V)
    assert not script.tasks[0].free_V.any()
    assert (script.tasks[0].V == V).all()
