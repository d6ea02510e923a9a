"""Trainers of the calibrating network. They see patterns and weights, and know no cameras."""

from __future__ import annotations

from neurocal_cli.training.task import Task, Trained, Trainer

__all__ = ["Task", "Trained", "Trainer"]
