"""Torch module to finished ONNX graph, checked against torch. Handed an ``nn.Module``; knows no detector."""
