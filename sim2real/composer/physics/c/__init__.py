"""The C engine: a compiled model and its state in MuJoCo itself, bound elements and images. Machinery."""
