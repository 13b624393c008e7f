"""A dozen small graphs, one for each thing that a compiled graph must get right."""

from oracles.hash_nodes import random_graph

from sim2real.graph import BaseNode, EmpiricalDist, Jitter, Scheduling


def by_name(*nodes: BaseNode):
    return {n.name: n for n in nodes}


def hiccups(usual: float, rare: float):
    """Return a delay that is ``rare`` [s] every eighth time."""
    return EmpiricalDist([usual] * 7 + [rare], block=8)


def loop(make):
    """Two nodes that listen to each other; no world."""
    a, b = make("a", 100, False, delay_dist=0.001), make("b", 50, False, delay_dist=0.003)
    b.connect(a, window=3)
    a.connect(b, skip=True, window=2)
    return by_name(a, b), "b"


def pair(make):
    """The smallest robot: a policy and its world."""
    world, policy = make("world", 100, True), make("policy", 50, False, delay_dist=0.002)
    policy.connect(world, skip=True, window=2)
    world.connect(policy, skip=True, delay_dist=0.004)
    return by_name(world, policy), "policy"


def robot(make, world_hz=100, policy_hz=50, **agent):
    """World, sensor, policy and actuator, as on a robot."""
    sensor, policy, actuator = (
        make(n, policy_hz, False, **{"delay_dist": 0.002, **o})
        for n, o in (("sensor", {}), ("policy", agent), ("actuator", {}))
    )
    world = make("world", world_hz, True)
    policy.connect(sensor, blocking=True, window=2)
    actuator.connect(policy, blocking=True)
    world.connect(actuator, skip=True, delay_dist=0.004)
    sensor.connect(world, skip=True, delay_dist=0.003)
    return by_name(sensor, policy, actuator, world), "policy"


def unequal_rates(make):
    """Nothing divides anything."""
    return robot(make, world_hz=125, policy_hz=30)


def three_in_ten(make):
    """The policy makes 3 steps in 10 ticks, with some jitter."""
    return robot(make, world_hz=100, policy_hz=30, delay_dist=hiccups(0.001, 0.003), delay=0.002)


def two_in_five(make):
    """The same for 2 steps in 5 ticks, and a second sensor at 80 Hz."""
    nodes, supervisor = robot(make, world_hz=100, policy_hz=40)
    nodes["fast"] = make("fast", 80, False, delay_dist=0.001)
    nodes["fast"].connect(nodes["world"], skip=True, window=3)
    nodes["policy"].connect(nodes["fast"], skip=True, window=2)
    return nodes, supervisor


def slow_world(make):
    """The policy is faster than its world."""
    return robot(make, world_hz=50, policy_hz=80)


def policy_with_hiccups(make):
    """Every eighth policy step takes more than a period; it then returns to its grid with steps back to back."""
    return robot(make, delay_dist=hiccups(0.001, 0.05), delay=0.002, scheduling=Scheduling.PHASE)


def diamond(make):
    """One sender, two ways, one reader; and back to the world."""
    world, left, right, policy = (
        make("world", 100, True),
        make("left", 100, False, delay_dist=0.001),
        make("right", 40, False, delay_dist=0.007),
        make("policy", 50, False, delay_dist=0.002),
    )
    for side in (left, right):
        side.connect(world, delay_dist=0.001, window=2)
        policy.connect(side, blocking=side is right)
    world.connect(policy, skip=True)
    return by_name(world, left, right, policy), "policy"


def two_worlds(make):
    """Two worlds that touch each other directly and through the policy."""
    fast, slow, policy = make("fast", 100, True), make("slow", 60, True), make("policy", 50, False, delay_dist=0.003)
    slow.connect(fast, skip=True)
    fast.connect(slow, skip=True)
    policy.connect(fast, skip=True, window=2)
    policy.connect(slow, skip=True)
    fast.connect(policy)
    slow.connect(policy)
    return by_name(fast, slow, policy), "policy"


def twice_the_same(make):
    """Two connections between the same two nodes, with different delays and windows."""
    nodes, supervisor = robot(make)
    nodes["policy"].connect(nodes["sensor"], name="old", window=3, skip=True, delay_dist=0.03, jitter=Jitter.BUFFER)
    return nodes, supervisor


def buffered(make):
    """Messages are held until they are due."""
    world, sensor = make("world", 100, True), make("sensor", 50, False, scheduling=Scheduling.PHASE)
    policy = make("policy", 50, False, delay_dist=hiccups(0.002, 0.011), delay=0.006)
    sensor.connect(world, skip=True, jitter=Jitter.BUFFER, delay=0.012, delay_dist=hiccups(0.002, 0.02))
    policy.connect(sensor, jitter=Jitter.BUFFER, delay=0.01, delay_dist=0.001, window=2)
    world.connect(policy, skip=True, jitter=Jitter.BUFFER, delay=0.02, delay_dist=0.001)
    return by_name(world, sensor, policy), "policy"


def advancing(make):
    """The policy starts as soon as its messages are there; so does the actuator behind it."""
    nodes, supervisor = robot(make)
    nodes["policy"].advance = nodes["actuator"].advance = True
    nodes["policy"].inputs["sensor"].delay = 0.008
    return nodes, supervisor


def open_loop(make):
    """Nobody talks to the world; a fast node listens, and nobody listens to it."""
    world, policy, logger = make("world", 100, True), make("policy", 30, False), make("logger", 250, False)
    policy.connect(world, skip=True)
    logger.connect(world, skip=True)
    logger.connect(policy, window=2)
    return by_name(world, policy, logger), "policy"


def slow_supervisor(make):
    """No world, and many steps of the others between two of the supervisor."""
    fast, slow = make("fast", 100, False, delay_dist=0.001), make("slow", 20, False, delay_dist=0.002)
    slow.connect(fast, window=4)
    fast.connect(slow, skip=True)
    return by_name(fast, slow), "slow"


def inner_loop(make, policy_hz=10):
    """A controller at the world's rate under a slow policy."""
    world, sensor, inner, policy = (
        make("world", 200, True),
        make("sensor", 200, False, delay_dist=0.0005),
        make("inner", 200, False, delay_dist=0.001),
        make("policy", policy_hz, False, delay_dist=0.0015),
    )
    sensor.connect(world)
    inner.connect(sensor)
    policy.connect(sensor)
    inner.connect(policy, skip=True)
    world.connect(inner, skip=True)
    return by_name(world, sensor, inner, policy), "policy"


def random_one(make):
    """A random graph with two worlds."""
    return random_graph(13, size=3, worlds=2, make=make), "n0"


ALL = [
    loop, robot, unequal_rates, three_in_ten, two_in_five, slow_world, policy_with_hiccups, diamond, two_worlds,
    twice_the_same, buffered, advancing, open_loop, slow_supervisor, random_one,
]  # fmt: skip
