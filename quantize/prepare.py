"""A float model directory, read and placed: what every later step starts from."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import onnx

from quantize.errors import QuantizeError
from quantize.graph import multiply_adds, name_nodes, tensor_shapes
from quantize.pixels import fold_pixels
from quantize.placement import PRODUCTS, Placement, place
from quantize.recipe import FLOAT_RECIPE, Recipe
from quantize.volumes import flatten_volumes
from runtime.contracts.manifest import ModelDirectory


@dataclass(frozen=True, slots=True)
class Prepared:
    """A float model, ready to be calibrated.

    Attributes:
        source: its directory.
        recipe: how it is going to be quantised.
        model: the graph, pixels folded, volumes flattened, nodes named.
        placement: where 8 bits go when nothing is given back.
        shapes: of the graph's tensors.
        pixel_note: why pixels were not folded; None where they were or should not be.
    """

    source: ModelDirectory
    recipe: Recipe
    model: onnx.ModelProto
    placement: Placement
    shapes: dict[str, tuple[int, ...]]
    pixel_note: str | None

    @property
    def products(self) -> dict[str, int]:
        """Multiply-adds of each node that has any, by name, in the order of the graph."""
        costs = {node.name: multiply_adds(node, self.shapes) for node in self.model.graph.node}
        return {name: cost for name, cost in costs.items() if cost > 0}


def prepare_model(directory: ModelDirectory, recipe: Recipe) -> Prepared:
    """Reads a float model and places a recipe on it.

    Raises:
        QuantizeError: The model is quantised already, or nothing in it can be.
    """
    if directory.manifest.recipe != FLOAT_RECIPE:
        raise QuantizeError(
            f"{directory.path}: found a model of recipe {directory.manifest.recipe}; expected a {FLOAT_RECIPE} one; "
            "give the directory that `edge export` wrote"
        )
    model = onnx.load(directory.model_path)
    name_nodes(model)
    note = None
    if recipe.fold_pixels:
        folding = fold_pixels(model)
        model, note = folding.model, folding.reason
    if recipe.flatten_volumes:
        model = flatten_volumes(model).model
    placement = place(model, recipe)
    if not any(_is_product(node) for node in model.graph.node if node.name in placement.nodes):
        raise QuantizeError(
            f"{directory.path}: found no operator of {', '.join(sorted(PRODUCTS))} with constant weights; expected "
            "one or more; export the model again"
        )
    return Prepared(directory, recipe, model, placement, tensor_shapes(model), note)


def int8_share(prepared: Prepared, given_back: Collection[str] = ()) -> float:
    """Share of the multiply-adds that compute in 8 bits, correlations included; 0 to 1."""
    nodes = place(prepared.model, prepared.recipe, given_back).nodes
    in_8_bits = set(nodes)
    if not prepared.recipe.quantize_correlation:
        in_8_bits -= {node.name for node in prepared.model.graph.node if node.op_type == "StereoCorrelation"}
    costs = prepared.products
    return sum(cost for name, cost in costs.items() if name in in_8_bits) / max(sum(costs.values()), 1)


def _is_product(node: onnx.NodeProto) -> bool:
    return node.op_type in PRODUCTS
