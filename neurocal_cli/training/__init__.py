"""Trainers of the calibrating network. They work on patterns and weights, not on cameras."""

from __future__ import annotations

from neurocal_cli.training.task import Task, Trained, Trainer

__all__ = ["Task", "Trained", "Trainer"]
