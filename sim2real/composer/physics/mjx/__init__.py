"""The MJX engine: the same tasks, compiled by JAX for many copies at once."""

from sim2real.composer.physics.mjx.import_mjx import mjx as mjx  # import this first: the modules below import it, too

# isort: split
from sim2real.composer.physics.mjx.physics import MjxPhysics as MjxPhysics
from sim2real.composer.physics.mjx.random import JaxRandomState as JaxRandomState
