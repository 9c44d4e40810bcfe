"""Ways out, CasADi, L4CasADi, ONNX, C and other toolboxes, and the proof that what went out is what was trained."""
