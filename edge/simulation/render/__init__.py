"""Draws a `Scene` through pinhole cameras with OpenGL: linear radiance, exact object ids, depth."""
