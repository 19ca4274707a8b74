"""A torch module to one finished ONNX graph."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import onnx
import torch
from torch import Tensor, nn

from export.errors import ExportError
from export.function_body import stereo_correlation_function
from export.mode import eval_mode
from export.passes import custom_nodes, finish
from runtime.contracts.correlation import DOMAIN, STEREO_CORRELATION, VERSION

OPSET_VERSION = 18
"""Everything that the networks need, and old enough for every runtime of the last three years."""

IR_VERSION = 10
"""The file format that goes with it; newer onnx packages would write one that onnxruntime refuses."""


def to_onnx(
    module: nn.Module,
    inputs: Mapping[str, Tensor],
    output_names: Sequence[str],
    *,
    opset_version: int = OPSET_VERSION,
) -> onnx.ModelProto:
    """Exports a module with fixed shapes.

    Args:
        module: The network; exported in eval mode, its mode put back afterwards.
        inputs: Example inputs by the names that the graph's inputs get, in the order of ``forward``.
        output_names: Names for what ``forward`` returns, in its order.
        opset_version: Of the standard operators; a later one for a module with operators that came later.

    Returns:
        The finished graph: weights inside, correlations as single custom nodes with their function beside.

    Raises:
        ExportError: torch cannot export the module, or a pass lost a part of it.
    """
    try:
        with eval_mode(module), torch.no_grad(), _quiet_exporter():
            program = torch.onnx.export(
                module,
                tuple(example.clone() for example in inputs.values()),  # one tensor twice would become one input
                dynamo=True,
                opset_version=opset_version,
                input_names=list(inputs),
                output_names=list(output_names),
                verbose=False,
            )
    except torch.onnx.errors.OnnxExporterError as error:
        reason = str(error).strip().splitlines()[0]
        raise ExportError(
            f"{type(module).__name__}: found that torch cannot export it ({reason}); expected a module"
            " without data-dependent shapes or branches; simplify its forward"
        ) from error
    if program is None:
        raise ExportError(f"{type(module).__name__}: found no program; expected one; use the pinned torch")
    model: onnx.ModelProto = program.model_proto
    return finish(_with_functions(model, opset_version))


def _with_functions(model: onnx.ModelProto, opset_version: int) -> onnx.ModelProto:
    """Adds the function bodies of the custom nodes and fixes the versions of all that the file names."""
    unknown = set(custom_nodes(model)) - {STEREO_CORRELATION}
    if unknown:
        raise ExportError(
            f"export: found nodes {sorted(unknown)} of {DOMAIN}; expected {STEREO_CORRELATION} alone;"
            " correlate through export.correlation"
        )
    del model.functions[:]
    versions = {"": opset_version}
    if custom_nodes(model):
        model.functions.append(stereo_correlation_function(opset_version))
        versions[DOMAIN] = VERSION
    del model.opset_import[:]
    model.opset_import.extend(onnx.helper.make_opsetid(domain, number) for domain, number in versions.items())
    model.ir_version = IR_VERSION
    return model


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Keeps torch's notes about packages not needed here, and its own deprecations, off the screen."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        logger.setLevel(level)
