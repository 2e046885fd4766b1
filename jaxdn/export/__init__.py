"""One recurrent step of a denoiser for programs that are not Python: StableHLO and ONNX."""
