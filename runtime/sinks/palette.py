"""Colours (BGR) of classes and surfaces in pictures."""

from __future__ import annotations

Colour = tuple[int, int, int]

CLASS_COLOURS: dict[str, Colour] = {
    "Car": (255, 190, 60),
    "Van": (200, 220, 90),
    "Truck": (255, 130, 170),
    "Pedestrian": (40, 190, 255),
    "Person_sitting": (70, 150, 255),
    "Cyclist": (170, 90, 255),
    "Tram": (130, 220, 130),
    "Misc": (190, 190, 190),
}
OTHER_CLASS: Colour = (200, 200, 200)
LABEL: Colour = (245, 245, 245)

BACKGROUND: Colour = (24, 20, 17)
PANEL: Colour = (38, 32, 28)
GRID: Colour = (72, 63, 56)
DIM_TEXT: Colour = (160, 150, 142)
TEXT: Colour = (240, 238, 235)
ACCENT: Colour = (150, 220, 120)
FIELD_OF_VIEW: Colour = (56, 47, 41)
EGO: Colour = (225, 220, 215)


def class_colour(name: str) -> Colour:
    """Colour of a class; grey for one that has none."""
    return CLASS_COLOURS.get(name, OTHER_CLASS)
