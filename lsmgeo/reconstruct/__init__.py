"""Posed images to depth maps, points, a mesh and a page to turn them around in: each method, and what is written."""
