"""From an image to grids: every chessboard of an image, with vertices accurate to a few tenths of a pixel.

Constants here were tuned on the conditions of tests/rendered.py, with other seeds than those that
tests/test_finding.py repeats them with. A comment calls them *insensitive* if halving or doubling any one of
them changed no vertex and no label in 27 images: 16 conditions, 2 of clutter, 6 random mixtures and 3
photographs.
"""
