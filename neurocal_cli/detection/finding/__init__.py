"""Where chessboards are in a picture: saddles, linked and grown into grids."""
