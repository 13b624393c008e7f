"""``mujoco.mjx``, imported without a word: without Warp it prints so to stdout, which is for data."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx as mjx

    from sim2real.composer.physics.mjx.chains import hold_links

hold_links()
