"""Model files: PLY and SPZ for viewers, ONNX for the renderer that flies."""
