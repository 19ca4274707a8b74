"""The page on targets says what the recipes do."""

from __future__ import annotations

from pathlib import Path

import pytest

from quantize.recipe import load_recipes

PAGE = Path(__file__).parents[2] / "docs" / "int8-targets.md"


def table() -> dict[str, list[str]]:
    first_part = PAGE.read_text(encoding="utf-8").partition("\n## ")[0]
    lines = [line for line in first_part.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    return {row[0]: row[1:] for row in cells}


def test_every_target_has_a_row() -> None:
    assert table().keys() == load_recipes().keys()


@pytest.mark.parametrize("target", sorted(load_recipes()))
def test_a_row_says_what_the_recipe_does(target: str) -> None:
    recipe = load_recipes()[target]
    words = {True: "yes", False: "no"}
    assert table()[target] == [
        recipe.verified,
        recipe.activation_type + (", symmetric" if recipe.activation_symmetric else ""),
        str(recipe.weight_bits),
        words[recipe.fold_pixels],
        words[recipe.column_outputs],
        words[recipe.exact_outputs],
        words[recipe.quantize_correlation],
        words[recipe.integer_moves],
        words[recipe.flatten_volumes],
        recipe.note,
    ]
    assert recipe.weight_per_channel
    assert recipe.equalise
    assert recipe.output_rounding
    assert not recipe.bias_correction
