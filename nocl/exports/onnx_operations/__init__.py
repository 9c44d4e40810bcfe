"""What ONNX's operations mean, on numbers that are known and on numbers that depend on the inputs."""
