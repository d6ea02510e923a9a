"""Outlier settings: pixels that fit no camera, or a camera that contradicts the other settings."""

from __future__ import annotations

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array
from neurocal_cli.zoom_lens.setting_normals import Tables
from neurocal_cli.zoom_lens.zoom_lens import ZoomLens

# The limits are wide, as a lens may change sharply between two settings. The tests of settings that are left
# out in tests/test_zoom_lens.py check both sides: wrong pixels and wrong names are found, and no setting of a
# lens that changes sharply is rejected.
_WRONG_PIXELS = 3.0  # times the median rms error of the settings
_SUSPECT = 4.0  # times the median cross-validation error; only such settings are examined
_SIGMAS = 8.0  # standard deviations from the prediction of all other settings, rms over the parameters
_LEAST_ERROR = 5.0  # times the noise, in the image


def bad_pixels(rms: Array) -> tuple[int, str] | None:
    """The setting that fits far worse than the others and the reason to reject it; rms is (S,) in px."""
    worst, typical = int(rms.argmax()), float(np.median(rms))
    if rms[worst] <= _WRONG_PIXELS * typical:
        return None
    return worst, f"its reprojection error is {rms[worst]:.3g} px, that of the others {typical:.3g} px"


def most_suspect(pixels: Array, normalised: Array) -> int | None:
    """The setting that the others predict worst, if far worse than the rest; of (S,) `left_out_errors`."""
    worst = int((normalised * pixels).argmax())
    return worst if pixels[worst] > _SUSPECT * np.median(pixels) else None


def contradiction(lens: ZoomLens, setting: Array, tables: Tables, s: int) -> str | None:
    """Reason to reject setting s, given a lens that was fitted without it; None to keep it.

    Parameters
    ----------
    lens : ZoomLens
    setting : (D,) array
    tables : Tables
        Fitted with the setting.
    s : int
    """
    try:
        prediction = lens.predict(setting[None])
    except InputError:  # no valid camera there, because another setting is wrong
        return None
    L = len(lens.names)
    H = tables.normal.H[s, :L, :L]
    error = prediction.local[0] - tables.local[s]
    own = lens.variance * np.linalg.pinv(H, hermitian=True)
    sigmas = float(np.sqrt(error @ np.linalg.solve(prediction.covariance[0, :L, :L] + own, error) / L))
    pixels = float(np.sqrt(max(error @ H @ error, 0.0) / max(tables.normal.H[s, 2, 2], 1.0)))
    if sigmas < _SIGMAS or pixels < _LEAST_ERROR * lens.noise_floor_px:
        return None
    return f"it is {pixels:.3g} px and {sigmas:.0f} standard deviations off what the other settings predict"
