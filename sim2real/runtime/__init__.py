"""Three ways to run a graph: on the wall clock, on a simulated clock, or compiled into one program.

A graph of a world and an agent, as every way takes it::

    import jax
    import jax.numpy as jnp
    from flax import struct

    from sim2real.graph import Base, BaseNode, BaseWorld

    @struct.dataclass
    class Number(Base):
        x: jax.Array

    class World(BaseWorld):
        def init_state(self, rng=None, graph_state=None):
            return Number(x=1.0)

        def init_output(self, rng=None, graph_state=None):
            return Number(x=1.0)

        def step(self, step_state):
            x = step_state.state.x + 0.01 * step_state.inputs["agent"][-1].data.x
            return step_state.replace(state=Number(x=x)), Number(x=x)

    class Agent(BaseNode):
        def init_output(self, rng=None, graph_state=None):
            return Number(x=0.0)

        def step(self, step_state):
            return step_state, Number(x=-2.0 * step_state.inputs["world"][-1].data.x)

    world, agent = World("world", rate=100), Agent("agent", rate=50, delay_dist=0.002)
    agent.connect(world, skip=True, delay_dist=0.003)
    world.connect(agent, delay_dist=0.001)

**The wall clock**: a thread for each node, measured times. On a robot, drivers take the place of the world::

    from sim2real.runtime.asynchronous import AsyncGraph
    from sim2real.runtime.clock import Clock

    with AsyncGraph([world, agent], agent, Clock.WALL_CLOCK) as graph:
        graph.warmup(state := graph.init(jax.random.key(0)))
        graph.start(state)
        measured = graph.run_for(0.5)

**A simulated clock**: drawn delays, steps in the order of time, any speed. A timeline makes it repeatable::

    from sim2real.graph.schedule import draw

    timeline = draw({"world": world, "agent": agent}, duration_s=1.0, episodes=4, rng=0)
    with AsyncGraph([world, agent], agent, Clock.SIMULATED, timeline=timeline) as graph:
        state, step_state = graph.reset(graph.init(jax.random.key(0)))
        for _ in range(20):
            state, step_state = graph.step(state)
        simulated = step_state.inputs["world"][-1].data.x

**Compiled**: the same timeline as data of one program, for ``jit``, ``vmap`` and ``grad``::

    from sim2real.runtime.compiled.graph import CompiledGraph

    compiled = CompiledGraph([world, agent], "agent", timeline)

    @jax.jit
    def play(eps):
        state, step_state = compiled.reset(compiled.init(jax.random.key(0), eps=eps))
        for _ in range(20):
            state, step_state = compiled.step(state)
        return step_state.inputs["world"][-1].data.x

    of_first_episode = play(0)
    of_all_episodes = jax.vmap(play)(jnp.arange(4))

In all three, each message arrives by the timing rules of docs/timing.md, so the last two give the same numbers.
"""
