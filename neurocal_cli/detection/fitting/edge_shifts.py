"""Shifts of edges towards the light side, which alternate from square to square.

A nonlinear response shifts an edge in proportion to its blur, by a share that depends on its levels. The
shift is the same for all edges if blur, light and response are. Motion blurs edges of one direction more than
others, haze and glare change the levels, and the tone mapping of phones changes the response over the image.
The terms of the shift that the edges of a board require are unknowns of its map:

    shift = c_0 + c_1 (s - 1) + s (c_2 A + c_3 B) + s (c_4 x + c_5 y + c_6 x^2 + c_7 x y + c_8 y^2)

s is the blur relative to its median. A and B are mean level and half contrast without their medians, in
median half contrasts.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.common_parameters import BoardBlur, FieldBlur
from neurocal_cli.detection.fitting.map_fit import MapFit
from neurocal_cli.detection.fitting.shading import Shading, polynomial_terms
from neurocal_cli.detection.fitting.strips import Lines
from neurocal_cli.detection.medians import upper_median

_KINDS = (range(1, 2), range(2, 4), range(4, 9))  # columns of the terms of blur, levels and place
# Insensitive. Excess variance of a map above which terms are tried; chi2 that each must gain, in variances of
# the residuals left; and number of edges for each unknown.
_NOT_NOISE, _GAIN, _EDGES = 1.3, 8.0, 4


@frozen_dataclass(eq=False)
class EdgeShifts:
    """Terms of the shifts of a board's edges."""

    blur: BoardBlur | FieldBlur
    shading: Shading
    middle: tuple[float, float, float]  # medians of blur [px], mean level and half contrast [DN]
    used: tuple[range, ...] = ()  # the required ones of `_KINDS`

    @classmethod
    def of(
        cls, blur: BoardBlur | FieldBlur, shading: Shading, lines: Lines, used: tuple[range, ...] = ()
    ) -> EdgeShifts:
        """Terms for the edges of a board."""
        mean, contrast = shading.at(lines.middle)
        middle = upper_median(blur.at(lines)[0]), upper_median(mean), upper_median(contrast)
        return cls(blur, shading, middle, used)

    def terms(self, lines: Lines) -> Array:
        """(E, K) derivatives of the shifts of edges by the unknowns; the first is the common shift."""
        if not self.used:
            return np.ones((len(lines.length), 1))
        return self._every(lines).take([0, *chain(*self.used)], axis=1)

    def beyond_response(self, lines: Lines, shift: Array) -> Array:
        """(E,) shifts [px] without the part that a common response causes, given the unknowns (K,)."""
        return self.terms(lines) @ shift - shift[0] * self._relative_blur(lines)

    def required(self, lines: Lines, mapped: MapFit, variance: Array, share: float) -> EdgeShifts:
        """Add the terms that the residuals of a map require.

        `variance` (E,) [px^2] is that of the edges, and `share` the greatest share of the squared residuals
        that each kind of terms may leave.
        """
        if not mapped.excess > _NOT_NOISE:
            return self
        count = len(variance)
        root = np.sqrt(mapped.weight[:count] / variance)
        every, residual = self._every(lines) * root[:, None], mapped.residual[:count] * root
        used, columns = self.used, [0, *chain(*self.used)]
        left = _left(every[:, columns], residual)
        for kind in _KINDS:
            more = [*columns, *kind]
            if kind in used or _EDGES * len(more) > count:
                continue
            rest = _left(every[:, more], residual)
            gain = (left - rest) * (count - len(more))
            if rest < share * left and gain > _GAIN * (len(more) - len(columns)) * rest:
                used, columns, left = (*used, kind), more, rest
        return self if used == self.used else replace(self, used=used)

    def _every(self, lines: Lines) -> Array:
        """(E, 9) all terms."""
        _, mean, contrast = self.middle
        s = self._relative_blur(lines)
        A, B = self.shading.at(lines.middle)
        levels = [s * (A - mean) / contrast, s * (B - contrast) / contrast]
        places = s[:, None] * polynomial_terms(self.shading.frame, lines.middle, 6)[:, 1:]
        return np.column_stack([np.ones_like(s), s - 1, *levels, places])

    def _relative_blur(self, lines: Lines) -> Array:
        return self.blur.at(lines)[0] / self.middle[0]


def _left(terms: Array, residual: Array) -> float:
    """Sum of the squared residuals that are left by the best combination of terms (E, K)."""
    size = np.sqrt(np.maximum((terms**2).sum(axis=0), 1e-30))
    best = np.linalg.lstsq(terms / size, residual, rcond=1e-6)[0]
    return float(((residual - terms / size @ best) ** 2).sum())
