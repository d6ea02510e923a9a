"""A free camera for each view: what one step and the quadratic there leave, beside hundreds of steps."""

import numpy as np
import pytest
from support.places import SAMPLES
from support.slow_cases import slow_but

from neurocal_cli import calibrate, read_points
from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.free_networks import free_networks, least_of_free_networks
from neurocal_cli.adjustment.reprojection import predicted_pixels
from neurocal_cli.calibration.verdict.evidence import Evidence
from neurocal_cli.camera.state import CameraState

FLAT = SAMPLES / "flat.csv"


@pytest.mark.parametrize(("distortion", "within"), [("none", 1e-5), ("plumb_bob", 0.006)])
def test_free_networks_are_at_the_minimum(distortion: str, within: float) -> None:
    found = Evidence(
        calibrate(read_points(FLAT), skew=False, distortion=distortion, outliers="keep", target="given")
    )
    state, views = found.state, found.views
    own = CameraState(np.repeat(state.entries, views.n_views, axis=0), state.R, state.t, state.model, state.k)
    free = np.arange(5 + len(state.k)) < 5
    minimum = adjust(views.batches, own, free, True, 1000).cost.sum()
    assert np.sqrt(free_networks(views, state).sum() / minimum) == pytest.approx(1.0, abs=within)


@pytest.mark.parametrize(
    ("name", "distortion"),
    slow_but((("bent", "k1"),), (("bent", "k1"), ("flat", "plumb_bob"), ("fisheye", "fisheye"))),
)
def test_the_common_camera_tells_nearly_what_many_steps_leave(name: str, distortion: str) -> None:
    points = read_points(FLAT.with_name(f"{name}.csv"))
    found = Evidence(calibrate(points, distortion=distortion, outliers="keep", target="given"))
    left = free_networks(found.views, found.state, 60).sum()
    assert np.sqrt(least_of_free_networks(found.minimum.normal).sum() / left) == pytest.approx(1.0, abs=0.1)


def test_views_that_the_camera_fits_exactly_leave_nothing() -> None:
    points = read_points(FLAT)
    found = Evidence(calibrate(points, skew=False, distortion="none", outliers="keep"))
    predicted, _ = predicted_pixels(found.given, points.world, points.view_index)
    exact = type(points)(points.world, predicted, view=points.view, image_size=points.image_size)
    found = Evidence(calibrate(exact, skew=False, distortion="none", outliers="keep"))
    left = free_networks(found.views, found.state)
    assert (left >= 0).all()
    assert left.sum() < 1e-20
