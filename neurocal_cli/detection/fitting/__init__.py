"""Fit the edges and vertices of a grid to all pixels around them, to the limit of accuracy.

The constants were tuned on the conditions of tests/support/rendered.py, with tests/support/measured.py
comparing the errors with the Cramer-Rao bound (from the Fisher information of the pixels);
test_measuring.py repeats this. A comment calls a constant *insensitive* if halving or doubling it
changed the ratio of error to bound, averaged over 14 conditions and 2 random mixtures, by at most 1 %.
"""
