"""What turns the exporter's graph into a finished one: simplified, named after the modules, free of traces.

The order matters: names are taken from what the exporter noted of each node's module, so they come first;
simplifying comes next, and forgetting the notes last. Each pass takes a model and returns a new or changed
one, and none may lose a custom node or a function: ``finish`` counts them before and after.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable

import onnx
import onnxsim

from export.errors import ExportError
from export.views import WRAPPER_PREFIX
from runtime.contracts.correlation import DOMAIN

_SCOPES = "pkg.torch.onnx.name_scopes"
_PRODUCER = "edge export"
_GRAPH = "detector"


def finish(model: onnx.ModelProto) -> onnx.ModelProto:
    """Applies all passes.

    Args:
        model: As the exporter wrote it, with the functions of its custom nodes.

    Returns:
        The same network, finished.

    Raises:
        ExportError: A custom node or a function was lost on the way, or the result is no valid ONNX.
    """
    nodes, functions = custom_nodes(model), {function.name for function in model.functions}
    model = strip_notes(simplify(name_after_modules(model)))
    if custom_nodes(model) != nodes or {function.name for function in model.functions} != functions:
        raise ExportError(
            f"export passes: found {dict(custom_nodes(model))} custom nodes and functions"
            f" {sorted(function.name for function in model.functions)} afterwards; expected {dict(nodes)} and"
            f" {sorted(functions)} as before; use the pinned onnxsim"
        )
    try:
        onnx.checker.check_model(model, full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        reason = str(error).splitlines()[0]
        raise ExportError(
            f"export passes: found a graph that the ONNX checker refuses ({reason}); expected a valid one;"
            " use the pinned onnx, onnxscript and onnxsim"
        ) from error
    return model


def custom_nodes(model: onnx.ModelProto) -> Counter[str]:
    """Counts the nodes of our operator domain, by operator."""
    return Counter(node.op_type for node in model.graph.node if node.domain == DOMAIN)


def name_after_modules(model: onnx.ModelProto) -> onnx.ModelProto:
    """Names nodes and the tensors between them after their torch modules.

    ``backbone.layer1.0.conv1/Conv`` says where in the network a node lies, which every later report about
    single layers relies on. Inputs, outputs and weights keep their names, weights without the wrapper's.
    """
    renamed: dict[str, str] = {}
    kept = {item.name for item in (*model.graph.input, *model.graph.output)}
    used = set(kept)
    for weight in model.graph.initializer:
        renamed[weight.name] = _unused(weight.name.removeprefix(WRAPPER_PREFIX), used)
        weight.name = renamed[weight.name]
    for node in model.graph.node:
        _replace(node.input, renamed)
        node.name = _unused(f"{_module_path(node)}/{node.op_type}".lstrip("/"), used)
        for index, output in enumerate(node.output):
            if output and output not in kept:
                suffix = f":{index}" if len(node.output) > 1 else ""
                renamed[output] = _unused(f"{node.name}{suffix}_output", used)
        _replace(node.output, renamed)
    del model.graph.value_info[:]
    return model


def simplify(model: onnx.ModelProto) -> onnx.ModelProto:
    """Folds constants and batch norms by onnxsim; whether the numbers stay is for `export.parity` to tell."""
    simplified: onnx.ModelProto = onnxsim.simplify(model)[0]
    return simplified


def strip_notes(model: onnx.ModelProto) -> onnx.ModelProto:
    """Removes stack traces, absolute paths, doc strings and what else the tools noted about themselves."""
    graph = model.graph
    parts = [model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer]
    for function in model.functions:
        parts += [function, *function.node]
    for part in parts:
        del part.metadata_props[:]
        part.doc_string = ""
    graph.name = _GRAPH
    model.producer_name, model.producer_version, model.domain, model.model_version = _PRODUCER, "", "", 0
    return model


def _module_path(node: onnx.NodeProto) -> str:
    """The module whose weight a node uses, else the innermost one that the exporter noted for it.

    The weight comes first, since a folded batch norm leaves its own name on the convolution before it.
    """
    for name in node.input[1:2]:
        if name.endswith(".weight"):
            return name.removesuffix(".weight")
    notes = {note.key: note.value for note in node.metadata_props}
    scopes: list[str] = ast.literal_eval(notes.get(_SCOPES, "[]"))
    path = next((scope for scope in reversed(scopes[:-1]) if scope), "")
    return f"{path}.".removeprefix(WRAPPER_PREFIX).removesuffix(".")


def _unused(name: str, used: set[str]) -> str:
    candidate, count = name, 1
    while candidate in used:
        count += 1
        candidate = f"{name}_{count}"
    used.add(candidate)
    return candidate


def _replace(names: Iterable[str], renamed: dict[str, str]) -> None:
    """Renames in place; ``names`` is a repeated field of the node."""
    for index, name in enumerate(names):
        if name in renamed:
            names[index] = renamed[name]  # type: ignore[index]
