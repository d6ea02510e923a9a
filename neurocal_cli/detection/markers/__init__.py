"""Boards with markers: `reading` reads them, `lattice` places them, `ink` takes them off the image."""
