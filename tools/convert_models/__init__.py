"""Networks of other people, from their PyTorch checkpoints to the ONNX files that ClearGS runs."""
