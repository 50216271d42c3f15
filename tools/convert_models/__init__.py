"""Convert published networks from PyTorch checkpoints to the ONNX files that ClearGS runs."""
