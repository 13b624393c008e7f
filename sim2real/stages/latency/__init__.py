"""The stage latency: where the milliseconds go between a command and the motion."""
