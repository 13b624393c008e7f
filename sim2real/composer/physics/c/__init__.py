"""The C engine: a compiled model and its state in MuJoCo, bound elements and images."""
