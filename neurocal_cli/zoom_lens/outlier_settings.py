"""Settings whose data are wrong: pixels that fit no camera, or a camera that fits no neighbour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.zoom_lens.cross_validation import LeftOut
from neurocal_cli.zoom_lens.static_calibration import Tables
from neurocal_cli.zoom_lens.zoom_lens import ZoomLens

__all__ = ["BadSetting", "bad_pixels", "doubtful", "stands_out"]

_PIXELS = 3.0  # times the median error of the settings, from which on the pixels are wrong
_DOUBT = 4.0  # times the median surprise of the settings; only then it is worth to look closer
_SIGMAS = 8.0  # standard deviations from what all the others predict, rms over the parameters
_VISIBLE = 5.0  # times the noise that the error must have in the image


@dataclass(frozen=True)
class BadSetting:
    """A setting's number and what is wrong with it."""

    setting: int
    reason: str


def bad_pixels(rms: Array) -> BadSetting | None:
    """The setting that fits worst, if it fits far worse than the others; rms is (S,) in px."""
    worst, typical = int(rms.argmax()), float(np.median(rms))
    if rms[worst] <= _PIXELS * typical:
        return None
    return BadSetting(
        worst, f"its reprojection error is {rms[worst]:.3g} px, that of the others {typical:.3g} px"
    )


def doubtful(errors: LeftOut) -> int | None:
    """The setting that surprises most, if it does so much more than the others."""
    worst = int((errors.surprise * errors.pixels).argmax())
    if errors.pixels[worst] <= _DOUBT * np.median(errors.pixels):
        return None
    return worst


def stands_out(lens: ZoomLens, setting: Array, tables: Tables, s: int) -> str | None:
    """Reason to leave out setting s, given a lens that learnt without it; None to keep it.

    Parameters
    ----------
    lens : ZoomLens
    setting : (D,) array
    tables : Tables
        With the setting.
    s : int
    """
    prediction = lens.predict(setting[None])
    L = len(lens.names)
    H = tables.normal.H[s, :L, :L]
    error = prediction.local[0] - tables.local[s]
    own = lens.variance * np.linalg.pinv(H, hermitian=True)
    sigmas = float(np.sqrt(error @ np.linalg.solve(prediction.covariance[0, :L, :L] + own, error) / L))
    pixels = float(np.sqrt(max(error @ H @ error, 0.0) / max(tables.normal.H[s, 2, 2], 1.0)))
    if sigmas < _SIGMAS or pixels < _VISIBLE * np.sqrt(2 * lens.variance):
        return None
    return f"it is {pixels:.3g} px and {sigmas:.0f} standard deviations off what the other settings predict"
