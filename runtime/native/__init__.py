"""Native ONNX Runtime kernels of the ``edge.stereo`` operators, built from the C++ beside this file."""
