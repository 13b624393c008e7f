"""The C engine: a compiled model and its state in MuJoCo itself, with cameras and bound elements."""
