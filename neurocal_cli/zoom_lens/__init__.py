"""Cameras with active lenses, the paper's section 4.2: how a camera's parameters follow zoom and focus.

Five multi-layer feed-forward networks give alpha_u, alpha_v, u0, v0 and t_z at any setting (and more
of them the lens's coefficients, where it bends); the other parameters are constants. They learn
together with the calibrating net, on the pixel error of all settings at once.
"""
