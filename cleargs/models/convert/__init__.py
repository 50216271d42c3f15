"""Conversion of published checkpoints to ONNX."""
