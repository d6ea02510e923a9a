"""Cameras with zoom lenses (the paper's "active lenses", section 4.2).

Multi-layer feed-forward networks predict alpha_u, alpha_v, u0, v0, t_z and the distortion coefficients at
any setting of zoom and focus. The other parameters are constants. All networks are trained on the
reprojection error of all settings.
"""
