"""What is measured of a rig before it is judged."""

from __future__ import annotations

from neurocal_cli.calibration import Verdict
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.stereo.contradiction import Contradiction


@frozen_dataclass(eq=False)
class RigEvidence:
    """What was measured.

    Attributes
    ----------
    cameras : two of Verdict or None
        On each camera by its own points.
    names : tuple of (left name, right name)
        All pairs in order of their names.
    size : (P,) array
        Of each pair's target [world unit].
    moved : Contradiction or None
        Of all pairs, also those that were left out as taken before or after the rig moved; None where it
        did not move.
    contradiction : Contradiction or None
        Of the pairs that determine the rig; None where it cannot be told.
    displacement : float [world unit]
        By how much, rms over the pairs, the target is elsewhere in the right camera than the rig says.
    held_out_px : float [px]
        Rms error of pairs left out in five folds; nan where nothing can be left out.
    depth : float [world unit]
        Median depth of the points.
    depth_share : float
        Standard deviation of triangulated depth over the depth, median over the points, for exact pixels.
    """

    cameras: tuple[Verdict | None, Verdict | None]
    names: tuple[tuple[str, str], ...]
    size: Array
    moved: Contradiction | None
    contradiction: Contradiction | None
    displacement: float
    held_out_px: float
    depth: float
    depth_share: float
