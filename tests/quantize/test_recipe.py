"""Recipes: read strictly, found by target, chosen by the CPU's flags."""

from __future__ import annotations

import json
from importlib.resources import files

import pytest

from quantize.errors import QuantizeError
from quantize.recipe import detect_target, load_recipes, parse_recipe, recipe_for_target


def text_of(name: str) -> str:
    return files("quantize").joinpath("recipes", name).read_text(encoding="utf-8")


def test_each_target_has_one_recipe_named_by_what_it_does() -> None:
    recipes = load_recipes()
    assert {"x86-vnni", "x86-avx2", "arm64", "generic", "openvino", "tensorrt"} == set(recipes)
    for target, recipe in recipes.items():
        assert recipe.target == target
        assert f"wi{recipe.weight_bits}" in recipe.name
        assert ("au8" if recipe.activation_type == "uint8" else "ai8") in recipe.name


@pytest.mark.parametrize(
    ("machine", "flags", "target"),
    [
        ("x86_64", {"avx2", "avx512_vnni"}, "x86-vnni"),
        ("AMD64", {"avx2", "avx_vnni"}, "x86-vnni"),
        ("x86_64", {"avx2"}, "x86-avx2"),  # u8 x s8 saturates: weights of 7 bits
        ("x86_64", {"sse2"}, "generic"),
        ("aarch64", set(), "arm64"),
        ("riscv64", set(), "generic"),
    ],
)
def test_target_by_cpu(machine, flags, target) -> None:
    assert detect_target(machine, frozenset(flags)) == target


@pytest.mark.parametrize(
    ("machine", "text", "target"),
    [
        ("x86_64", "flags : fpu avx2 avx512_vnni\n", "x86-vnni"),
        ("x86_64", "flags : fpu avx2\n", "x86-avx2"),
        ("x86_64", None, "generic"),
        ("aarch64", "Features : fp asimd asimddp\n", "arm64"),
    ],
)
def test_target_of_this_machine(machine, text, target, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("runtime.machine.CPU_INFO", tmp_path / "cpuinfo")
    if text is not None:
        (tmp_path / "cpuinfo").write_text(text, encoding="utf-8")
    assert detect_target() == target


def test_saturating_cpus_get_seven_bits() -> None:
    assert recipe_for_target("x86-avx2").weight_bits == 7
    assert recipe_for_target("x86-vnni").weight_bits == 8


def test_an_unknown_target_is_refused() -> None:
    with pytest.raises(QuantizeError, match="x86-vnni"):
        recipe_for_target("z80")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"extra": 1}, "extra"),
        ({"weight_bits": 4}, "weight_bits"),
        ({"fold_pixels": 1}, "fold_pixels"),
        ({"activation_type": "int4"}, "activation_type"),
    ],
)
def test_a_wrong_recipe_is_refused(change, said) -> None:
    data = {**json.loads(text_of("static_wi8_au8_x86_vnni.json")), **change}
    with pytest.raises(QuantizeError, match=said):
        parse_recipe(json.dumps(data), where="recipe")


@pytest.mark.parametrize("text", ["", "[]", "{}", "{"])
def test_no_recipe_at_all_is_refused(text) -> None:
    with pytest.raises(QuantizeError, match="recipe"):
        parse_recipe(text, where="recipe")
