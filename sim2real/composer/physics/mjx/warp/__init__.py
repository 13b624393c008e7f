"""MJX on the kernels of MuJoCo Warp."""
