"""The verdict on a result that must have one."""

from __future__ import annotations

from typing import Protocol

from neurocal_cli.calibration.calibration import Verdict


class _Judged(Protocol):
    @property
    def verdict(self) -> Verdict | None: ...


def verdict_on(found: _Judged) -> Verdict:
    """The verdict on a camera, a rig or an evaluation; there is one."""
    assert found.verdict is not None
    return found.verdict
