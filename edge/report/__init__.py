"""Turns records of measurements into report.md, report.json and pictures."""
