"""Contracts shared by all rooms: frames, geometry, objects, model directory, measurements. NumPy only."""
