"""Exact rendering of boards: the light of a `Scene`, and which points of its boards can be seen."""
