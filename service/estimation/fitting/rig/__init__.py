"""Rig recordings before a fit: strokes, loadings, checks."""
