"""The parts of a verdict: findings with a grade, a reason and advice, causes, and limits for the grades.

A cause is a value with its words, whether it is one of a camera (`rivals`), of the rows of a file
(`mistakes`), of a rig (`rig.causes`), of matches (`rig.match_mistakes`) or of a zoom lens (`zoom.judgement`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import Generic, TypeVar

import numpy as np

from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import STRETCHED

WORDS = ("good", "usable", "poor")
"""By grade."""

_Its = TypeVar("_Its")  # cause
_About = TypeVar("_About")
Finding = tuple[int, str, str]
"""Grade (0 good, 1 usable, 2 poor), reason, advice."""
Said = tuple[str, float]
"""A reason, and the size that the limit of its cause grades."""

# Repeated by test_rivals.py (slow). Of 399 clean sets, with all lenses, the best of all rivals exceeds it in
# four, of which the verdict names one: in the others it displaces no pixels, or cannot be told from another.
LEVEL = 6.0
"""Log odds from which on a cause is more than chance, and by which it has to beat another one."""
TOLD = (2 * LEVEL) ** 0.5
"""The same in standard deviations: from so many on, a difference is more than chance."""
EXPLAINED = 0.5
"""Least share of the squared error beyond chance that causes explain if they are named."""
DETERMINE = 3
"""Views that determine a camera of their own, or tell bends of a target; more can contradict each other."""
FEW_POINTS = 12
"""Fewest points that tell the size of their noise, to a fifth."""
FEWEST = 6
"""Fewest points that have something in common by a cause: so few do by chance once in 500,000 sets."""
NO_WORSE = 1.05
"""Factor by which one rms error of a camera is worse than another at least."""
EXACT = 1e-4
"""Of the pixels' spread: an rms error this small is negligible."""
ROUNDED = 1e-5
"""The same, 0.01 px of 12 Mpx: that of rounded numbers, which has no cause."""
MISFIT = 0.05  # of the pixels' spread: an rms error this large is neither noise nor distortion
_SHOWN = 3
# Equations beyond the unknowns from which 95 % lie within 1.4 and within 1.2 times two standard deviations
# (Student's t).
SPARE = (4, 8)
"""Equations beyond the unknowns, below which a variance is hardly known, and not well known."""


@frozen_dataclass
class Limit:
    """Limits above which a quantity is no longer good, and above which it is poor."""

    good: float
    poor: float

    def grade(self, value: float) -> int:
        """0 good, 1 usable, 2 poor; nan counts as good."""
        return int(value > self.good) + int(value > self.poor)


POOR = Limit(0.0, 0.0)
"""Limits of what has no amount."""


@frozen_dataclass(eq=False)
class Cause(Generic[_About]):
    """What is said of a cause."""

    cause: str  # its name
    looks: str  # what the data look like that show it
    advice: str
    say: Callable[[_About], Said]
    limit: Limit

    def finding(self, about: _About, others: Iterable[str] = ()) -> Finding:
        """What it says about the data, and the names of others that are hardly less probable."""
        reason, size = self.say(about)
        return self.limit.grade(size), reason + or_else(others), self.advice


@frozen_dataclass(eq=False)
class Mistake(Cause[_About]):
    """A mistake in the data, without unknowns: with the opposite change they would fit."""

    mended: Callable[[_About], _About | None]  # None if the data cannot have it
    pixel: float = 1.0  # of the data as given, in the mended ones


def said(text: str) -> Callable[[object], Said]:
    """Words of a cause without an amount."""
    return lambda about: (text, 1.0)


# Rms over the image's diagonal: 0.16 px and 4 px of 640 x 480. Boards that are held by hand or stand on an
# easel bend by as much as the first from view to view.
DISPLACED = Limit(0.0002, 0.005)
"""Limits of displaced pixels, over the image's diagonal."""


STRETCHED_PRINT = Limit(STRETCHED, 0.025)
"""Limits of a stretch of one side against the other that printers make."""
WRONG_PRINT = "no print is so far off, so its description is wrong, and the scale of the poses unknown"

ERROR = Limit(0.00125, 0.006)
"""Limits of the rms error over the image's diagonal: 1 and 5 px of 640 x 480."""
SHARE = Limit(0.01, 0.05)
"""Limits of an error or a std over the value, or over the focal length."""
CONTRADICTION = Limit(1.6, 2.3)
"""Limits of an rms error over that of parts fitted by themselves: views, or the cameras of a rig."""
ELSEWHERE = Limit(1.5, 4.0)
"""Limits of an error at other points over that at the own ones (test_given_points.py, cross-validation)."""
OUTLIERS = Limit(0.02, 0.2)
"""Limits of the share of outliers, of all points and of those of a view; clean views lose none."""
CORRELATED = Limit(0.5, 0.85)
"""Limits of the correlation of neighbouring residuals, from which on they are no measurement noise."""


def log_odds(before: float, after: float, n: float, unknowns: float = 0.0, choices: float = 1.0) -> float:
    """Log odds of a cause that lowers the squared error of n equations from one value to another.

    The noise is what it leaves, and the prior of each of its unknowns is worth one equation (Schwarz 1978).
    """
    return 0.5 * (n * float(np.log(before / after)) - unknowns * float(np.log(n))) - float(np.log(choices))


def likeliest(causes: Iterable[tuple[float, _Its]]) -> list[_Its]:
    """Of causes with their log odds, those that are more than chance and hardly less probable than the best.

    They stay in their order; one whose odds are nan is unknown.
    """
    told = [(odds, cause) for odds, cause in causes if odds > LEVEL]
    best = max((odds for odds, _ in told), default=0.0)
    return [cause for odds, cause in told if odds > best - LEVEL]


def verdict_of(findings: Iterable[Finding], measures: Mapping[str, float]) -> Verdict:
    """Verdict with the word of the worst finding, and all reasons and advice, the worst first, each once."""
    found = sorted((f for f in findings if f[0] > 0), key=lambda f: -f[0])
    return Verdict(
        WORDS[found[0][0] if found else 0],
        tuple(dict.fromkeys(f[1] for f in found if f[1])),
        tuple(dict.fromkeys(f[2] for f in found if f[2])),
        measures,
    )


def two_digits(value: float) -> str:
    """Write a number with two significant digits, a large one without an exponent.

    Examples
    --------
    >>> two_digits(0.123), two_digits(234.5)
    ('0.12', '230')
    """
    return f"{float(f'{value:.2g}'):.15g}"


def percent(share: float) -> str:
    """Write a share in percent with two significant digits.

    Examples
    --------
    >>> percent(0.0123), percent(1.234)
    ('1.2 %', '120 %')
    """
    return f"{two_digits(100 * share)} %"


def name_some(names: Iterable[object]) -> str:
    """List the first names, and the number of further ones."""
    some = [str(name) for name in names]
    more = len(some) - _SHOWN
    return ", ".join(some[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def or_else(causes: Iterable[str]) -> str:
    """What is added to a cause that others are hardly less probable than."""
    told = ", ".join(causes)
    return f" (or, hardly less probable: {told})" if told else ""


@lru_cache(maxsize=4)  # each rival asks for it
def in_sequence(names: tuple[str, ...]) -> tuple[int, ...]:
    """Indices that sort names of views in natural order, in which img2 comes before img10."""

    def key(place: int) -> list[tuple[bool, int, str]]:
        parts = re.findall(r"\d+|\D+", names[place])
        return [(not part[0].isdecimal(), int(part) if part[0].isdecimal() else 0, part) for part in parts]

    return tuple(sorted(range(len(names)), key=key))


def image_diagonal(points: Correspondences) -> float:
    """Diagonal of the image [px]; of the pixels' bounding box if the image size is unknown."""
    return float(np.hypot(*(points.image_size or np.ptp(points.pixels, axis=0))))


def pixel_spread(points: Correspondences) -> float:
    """Rms distance of the pixels from their mean [px]."""
    return float(np.sqrt(points.pixels.T.copy().var(axis=1).sum()))  # ten times as fast as along columns
