"""Find every chessboard of an image as a grid of vertices, accurate to a few tenths of a pixel.

The constants were tuned on the conditions of tests/support/rendered.py; test_finding.py repeats these
with other seeds. A comment calls a constant *insensitive* if halving or doubling it changed no vertex and no
label in 27 images: 16 conditions, 2 of clutter, 6 random mixtures and 3 photographs.
"""
