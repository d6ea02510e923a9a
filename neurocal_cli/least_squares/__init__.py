"""Nonlinear least squares that knows no cameras: steps, Schur complements, covariances, leaving out."""
