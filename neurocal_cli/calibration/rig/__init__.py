"""Cameras that are fixed to each other: calibration of their rig, its verdict, triangulation."""
