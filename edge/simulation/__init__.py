"""Procedural stereo drives with exact labels."""
