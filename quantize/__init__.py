"""ONNX graph, ranges and recipe to an INT8 ONNX graph."""
