"""Advice on the views to photograph next."""
