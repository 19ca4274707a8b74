"""Unlabelled surroundings: ground, buildings, plants, street furniture."""
