"""Wide lenses: directions to pixels and back, beyond 90 degrees, beside the same written plainly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy
from support.wide_cameras import plainly_projected

from neurocal_cli.camera import rich_lens
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import BY_DIRECTION, DECENTRED, WIDE, project_directions
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import largest_angle, unproject_directions
from neurocal_cli.camera.pinhole import Intrinsics

every_wide_model = pytest.mark.parametrize("model", list(WIDE))
quick = settings(max_examples=12, deadline=None)

_RANGES = {
    "fisheye": ((-0.1, 0.1), (-0.03, 0.03), (-0.005, 0.005), (-0.001, 0.001)),
    "omnidir": ((0.1, 2.5), (-0.2, 0.2), (-0.03, 0.03), (-0.001, 0.001), (-0.001, 0.001)),
    "double_sphere": ((-0.4, 0.9), (0.2, 0.8)),
    "eucm": ((0.1, 0.8), (0.5, 2.0)),
    "rich": (
        (0.0, 0.02), (0.0, 0.005), (0.0, 0.001), (0.0, 0.0001),
        (0.6, 1.5), (0.6, 1.5), (0.6, 1.5), *((-0.003, 0.003),) * len(rich_lens.NODES),
    ),
}  # fmt: skip


def lenses(model: str) -> SearchStrategy[Distortion]:
    """Random lenses of a model."""
    if len(_RANGES[model]) > 10:
        low, high = np.transpose(_RANGES[model])
        return st.integers(0, 10**6).map(
            lambda seed: Distortion(model, np.random.default_rng(seed).uniform(low, high))
        )
    return st.tuples(*(st.floats(*pair) for pair in _RANGES[model])).map(lambda k: Distortion(model, k))


def directions(theta: Array, phi: Array) -> Array:
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


@every_wide_model
@quick
@given(data=st.data())
def test_every_model_is_as_its_paper_writes_it(model: str, data: st.DataObject) -> None:
    lens = data.draw(lenses(model))
    rng = np.random.default_rng(0)
    rays = directions(rng.uniform(0.01, 0.95 * largest_angle(lens), 20), rng.uniform(0, 2 * np.pi, 20))
    found = project_directions(model, lens.coefficients, *rays.T)
    expected = plainly_projected(model, lens.coefficients.tolist(), np.eye(3), rays)
    np.testing.assert_allclose(np.column_stack([found.x, found.y]), expected, rtol=1e-9, atol=1e-12)


@every_wide_model
@quick
@given(data=st.data())
def test_directions_come_back_from_their_pixels(model: str, data: st.DataObject) -> None:
    lens = data.draw(lenses(model))
    rng = np.random.default_rng(1)
    rays = directions(rng.uniform(0, 0.99 * largest_angle(lens), 200), rng.uniform(0, 2 * np.pi, 200))
    seen = project_directions(model, lens.coefficients, *rays.T)
    # Tangential terms, which the largest angle leaves out, may end the image of a few directions before.
    assert seen.seen.mean() > 0.97
    back = np.column_stack(unproject_directions(lens, seen.x, seen.y))
    np.testing.assert_allclose(back[seen.seen], rays[seen.seen], atol=1e-8)


@every_wide_model
@quick
@given(data=st.data())
def test_the_image_grows_up_to_the_largest_angle_and_no_farther(model: str, data: st.DataObject) -> None:
    lens = data.draw(lenses(model))
    if model == "omnidir":
        lens = Distortion(model, lens.coefficients * [1, 1, 1, 0, 0])
    if model == "rich":  # whose displacement is small, and does not count
        lens = Distortion(model, lens.coefficients[:7])
    limit = largest_angle(lens)
    theta = np.linspace(0, limit, 2000, endpoint=False)
    x = project_directions(model, lens.coefficients, *directions(theta, 0 * theta).T).x
    assert (np.diff(x) > 0).all()
    if limit < np.pi - 1e-3:
        beyond = directions(np.array([limit + 1e-3]), np.zeros(1))
        assert not project_directions(model, lens.coefficients, *beyond.T).seen[0]
        assert not Camera(Intrinsics(1, 1, 0, 0), lens).sees(beyond)[0]


def test_a_decentred_fisheye_has_the_tangential_terms_after_its_polynomial() -> None:
    k = [0.02, -0.01, 0.004, -0.001, 0.002, -0.003]
    rays = directions(np.linspace(0.1, 1.8, 20), np.linspace(0, 6, 20))
    x, y = (bent := project_directions("fisheye", k[:4], *rays.T)).x, bent.y
    r2, found = x**2 + y**2, project_directions(DECENTRED["fisheye"], k, *rays.T)
    np.testing.assert_allclose(found.x, x + 2 * k[4] * x * y + k[5] * (r2 + 2 * x**2), rtol=1e-12)
    np.testing.assert_allclose(found.y, y + k[4] * (r2 + 2 * y**2) + 2 * k[5] * x * y, rtol=1e-12)


@pytest.mark.parametrize("model", list(BY_DIRECTION))
def test_derivatives_behind_the_camera_too(model: str) -> None:
    k = {
        "fisheye": [0.02, -0.01, 0.002, 0],
        DECENTRED["fisheye"]: [0.02, -0.01, 0.002, 0, 1e-3, 2e-3],
        DECENTRED["double_sphere"]: [-0.2, 0.6, 1e-3, 2e-3],
        DECENTRED["eucm"]: [0.6, 1.1, 1e-3, 2e-3],
        "omnidir": [1.1, -0.1, 0.02, 1e-3, 2e-3],
        "double_sphere": [-0.2, 0.6],
    }.get(model, [0.6, 1.1])
    if model == "rich":
        k = [0.02, -0.01, 0.002, 0, 1.2, 1.1, 0.9]
        k = np.append(k, np.random.default_rng(3).normal(0, 0.003, len(rich_lens.NODES)))
    camera = Camera(Intrinsics(300, 310, 320, 240, 1.56), Distortion(model, k))
    rng = np.random.default_rng(2)
    rays = directions(rng.uniform(0.05, 1.8, 50), rng.uniform(0, 2 * np.pi, 50)) * rng.uniform(1, 3, (50, 1))
    by_camera, by_point = camera.project_jacobian(rays)
    h = 1e-6
    numeric = np.stack(
        [(camera.project(rays + h * e)[0] - camera.project(rays - h * e)[0]) / (2 * h) for e in np.eye(3)], -1
    )
    np.testing.assert_allclose(by_point, numeric, rtol=1e-5, atol=1e-4)
    for n in range(len(k)):
        ends = []
        for sign in (1, -1):
            moved = np.array(k, dtype=float)
            moved[n] += sign * h
            ends.append(Camera(camera.intrinsics, Distortion(model, moved)).project(rays)[0])
        np.testing.assert_allclose(
            by_camera[:, :, 5 + n], (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-3
        )


def test_a_fisheye_is_opencvs() -> None:
    cv2 = pytest.importorskip("cv2")
    camera = Camera(Intrinsics(300, 310, 320, 240), Distortion("fisheye", [0.02, -0.01, 0.003, -0.001]))
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -2, 0.5], [2, 2, 3], (100, 3))
    expected = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.A, camera.distortion.coefficients
    )[0]
    np.testing.assert_allclose(camera.project(points)[0], expected.reshape(-1, 2), atol=1e-6)


def test_a_direction_on_the_axis_and_its_opposite() -> None:
    for model, k in (("fisheye", [0.0] * 4), ("eucm", [0.6, 1.1])):
        camera = Camera(Intrinsics(300, 300, 320, 240), Distortion(model, k))
        pixels, seen = camera.project(np.array([[0.0, 0.0, 2.0]]))
        np.testing.assert_allclose(pixels, [[320.0, 240.0]], atol=1e-9)
        assert seen[0]
    eucm = Camera(Intrinsics(300, 300, 320, 240), Distortion("eucm", [0.6, 1.1]))
    pixels, seen = eucm.project(np.array([[0.0, 0.0, -1.0]]))
    assert not seen[0]
    assert np.isnan(pixels).all()
