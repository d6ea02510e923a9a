"""Simulated data with known truth: scenes, rendered chessboards, and studies of noise, starts and rates."""
