"""Nonlinear least squares, independent of cameras: steps, Schur complements, covariances, leave-one-out."""
