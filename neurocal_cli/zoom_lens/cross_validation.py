"""Settings predicted from all others: cross-validation, and settings that contradict the rest.

Near the minimum the networks are linear in their weights. With K = J A^-1 J^T H and the error e_s of setting
s, the error of its prediction from all others is (I - K_ss)^-1 e_s (the PRESS formula), without training
again. A setting that is suspect by this error is left out of a lens that is trained anew, which decides.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.zoom_lens.initialisation import CalibratedSettings
from neurocal_cli.zoom_lens.joint_training import Joint
from neurocal_cli.zoom_lens.quadratic_error import inverse, with_scatter
from neurocal_cli.zoom_lens.setting_normals import Tables
from neurocal_cli.zoom_lens.zoom_lens import ZoomLens

# The limits are wide, as a lens may change sharply between two settings. The tests of settings that are left
# out in tests/test_zoom_lens.py check both sides: wrong names are found, and no setting of a lens that
# changes sharply is rejected.
_SUSPECT = 4.0  # times the median cross-validation error; only such settings are examined
_SIGMAS = 8.0  # standard deviations from the prediction of all other settings, rms over the parameters
_LEAST_ERROR = 5.0  # times the noise, in the image


def left_out_errors(start: CalibratedSettings, joint: Joint) -> tuple[Array, Array]:
    """Errors at settings (S,), each predicted from all others.

    The first are rms reprojection errors [px]. The second are squared errors of the local parameters over
    their expectation, a mean over them; about 1.
    """
    tables, variance = start.tables, start.variance
    scatter = joint.nets.local_scatter(tables.local)
    local, J = joint.nets.local_with_jacobian(start.controls)
    _, L, P = J.shape
    normal = tables.normal
    H = normal.H[:, :L, :L]
    spread = J @ joint.covariance[:P, :P] @ np.swapaxes(J, 1, 2)
    # The constants of the networks differ from those of the tables; the effect is small.
    error = local - tables.local
    K = spread @ with_scatter(normal, scatter, variance).H[:, :L, :L] / variance
    remain = np.eye(L) - K
    out = np.asarray(np.linalg.solve(remain, error[..., None]), dtype=np.float64)
    spread_out = np.linalg.solve(remain, spread)
    own = variance * inverse(H) + np.diag(scatter)
    expected = np.asarray(spread_out + own)
    normalised = (out * solve_scaled(expected, out, ROUNDING)).sum(axis=(1, 2)) / L
    squares = (np.swapaxes(out, 1, 2) @ H @ out)[:, 0, 0] + normal.cost
    counts = np.maximum(normal.H[:, 2, 2], 1.0)  # the derivative by u0 is 1, so this is the number of points
    return np.sqrt(np.maximum(squares, 0.0) / counts), np.maximum(normalised, 0.0)


def most_suspect(pixels: Array, normalised: Array) -> int | None:
    """The setting that the others predict worst, if far worse than the rest; of (S,) `left_out_errors`."""
    worst = int((normalised * pixels).argmax())
    return worst if pixels[worst] > _SUSPECT * np.median(pixels) else None


def contradiction(lens: ZoomLens, setting: Array, tables: Tables, s: int) -> str | None:
    """Reason to reject setting s, given a lens that was fitted without it; None to keep it.

    The tables were fitted with the setting, whose controls are `setting` (D,).
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
