"""From a grid to its limit of accuracy: edges and vertices fitted to all the pixels around them.

Constants here were tuned on the conditions of tests/rendered.py, with tests/measured.py comparing errors with
their bound (Fisher information of the pixels); tests/test_measuring.py repeats this.
A comment calls them *insensitive* if halving or doubling any one of them changed the ratio of error to bound,
averaged over 14 conditions and 2 random mixtures, by less than 1 %.
"""
