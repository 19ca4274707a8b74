"""Labelled objects as procedural low-poly meshes, each filling its KITTI box exactly."""
