"""The measures of a rig from which its verdict follows."""

from __future__ import annotations

from neurocal_cli.calibration import Verdict
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.stereo.contradiction import Contradiction


@frozen_dataclass(eq=False)
class RigEvidence:
    """Measures of a rig's quality.

    Attributes
    ----------
    cameras : two of Verdict or None
        Verdict on each camera by its own points.
    names : tuple of (left name, right name)
        All pairs in order of their names.
    size : (P,) array
        Of each pair's target [world unit].
    moved : Contradiction or None
        Of all pairs, including those left out because the rig moved; None if it did not move.
    contradiction : Contradiction or None
        Of the pairs that determine the rig; None if a view does not determine its pose.
    displacement : float [world unit]
        Rms distance of the targets from their positions predicted by the rig, in the right camera.
    held_out_px : float [px]
        Five-fold cross-validation error over pairs; nan if no pair can be left out.
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
