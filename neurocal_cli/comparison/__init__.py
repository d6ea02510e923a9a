"""Comparison of the network with other methods on the same points."""
