"""Simulated data with everything known about it: rendered chessboards, a zoom lens."""
