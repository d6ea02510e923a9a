"""Comparison of the network with the other methods on the same points."""
