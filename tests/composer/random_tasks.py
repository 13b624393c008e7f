"""Random tasks, made with dm_control's composer or with ours; ``fuzz`` plays them.

A task has bodies, joints, tendons, actuators, sensors, perhaps contacts; observables of the task and of its entities
with delays, intervals, buffers, aggregators and corruptors; variations of the MJCF and of the physics; and hooks of the
task and of its entities that read, write, vary and draw.
"""

import copy
import importlib
from types import SimpleNamespace

import mujoco
import numpy as np
import random_links

JOINTS = {"hinge": [-0.4, 0.4], "slide": [-0.1, 0.1], "ball": [0, 0.8]}
SHAPES = {"sphere": [0.05], "capsule": [0.03, 0.08], "box": [0.05, 0.06, 0.04]}
TOUCH = {"sphere": (2, 3), "capsule": (4, 1), "box": (0, 0)}
"""Spheres and capsules with the floor, spheres with each other: there MJX's functions find the contacts of C's."""
AT_SITES = ("accelerometer", "gyro", "velocimeter", "force", "torque", "magnetometer")
OF_FRAMES = ("framepos", "framequat", "framexaxis", "framelinvel", "frameangvel", "framelinacc", "frameangacc")
OF_BODIES = ("subtreecom", "subtreelinvel", "subtreeangmom")
OF_JOINTS = ("jointpos", "jointvel", "jointactuatorfrc")
OF_ACTUATORS = ("actuatorpos", "actuatorvel", "actuatorfrc")
ACTUATORS = (
    ("motor", {"gear": [2.0]}), ("position", {"kp": 5.0}), ("velocity", {"kv": 0.3}),
    ("general", {"dyntype": "filter", "dynprm": [0.05], "gainprm": [1.5]}),
    ("general", {"dyntype": "integrator", "gainprm": [2.0], "biastype": "affine", "biasprm": [0, -2.0, -0.1]}),
)  # fmt: skip
OBSERVED = (
    ("site", "xpos"), ("sensor", "sensordata"), ("joint", "qpos"), ("joint", "qvel"), ("joint", "qacc"),
    ("body", "xquat"), ("geom", "xpos"), ("actuator", "force"), ("site", "xmat"), ("body", "subtree_com"),
    ("tendon", "length"),
)  # fmt: skip
OPERATIONS = (
    ("joint", "qvel", 0.9, 0.0), ("joint", "qpos", 1.0, 0.02), ("joint", "qfrc_applied", 0.0, 0.3),
    ("body", "xfrc_applied", 0.0, 0.2), ("actuator", "ctrl", 0.5, 0.1), ("mocap", "mocap_pos", 1.0, 0.01),
    ("site", "pos", 1.0, 0.01), ("body", "pos", 1.0, 0.005), ("geom", "pos", 1.0, 0.005),
    ("geom", "friction", 1.0, 0.01), ("joint", "damping", 1.1, 0.0), ("body", "gravcomp", 0.5, 0.2),
    ("geom", "rgba", 0.5, 0.1),
    ("site", "xpos", None, None), ("sensor", "sensordata", None, None), ("joint", "qacc", None, None),
    ("geom", "xmat", None, None), ("actuator", "force", None, None), ("tendon", "velocity", None, None),
    ("joint", "qvel", "draw", 0.05), ("joint", "qvel", "part", 0.1), ("body", "xfrc_applied", "part", 0.2),
    ("gravity", "", None, None), ("vary", "", None, None),
)  # fmt: skip
"""What hooks do: elements, attribute, and the factor and the offset that it is written with; None: it is only read."""
VARIED = {
    "joint": ("damping", "armature", "stiffness"), "geom": ("friction", "size"), "body": ("mass", "inertia", "pos"),
    "actuator": ("gear",), "site": ("pos",),
}  # fmt: skip
DERIVED = ("armature", "stiffness", "size", "mass", "inertia", "pos", "gear")
"""What MuJoCo computes constants from: dm_control leaves them stale, so its task has them computed here."""
HOOKS = ("initialize_episode", "before_step", "before_substep", "after_substep", "after_step")


def kit(name):
    """Return the modules of ``dm_control`` or ``sim2real`` that tasks are made of."""
    paths = {"composer": "", "observable": ".observation.observable", "variation": ".variation"}
    paths |= {k: f".variation.{k}" for k in ("deterministic", "distributions", "noises")}
    found = {k: importlib.import_module(f"{name}.composer{v}") for k, v in paths.items()}
    found["mjcf"] = importlib.import_module("dm_control.mjcf" if name == "dm_control" else f"{name}.composer.mjcf")
    return SimpleNamespace(name=name, **found)


class Draw:
    """Two streams of random numbers: what a task is made of, and the numbers in its model, which may vary alone."""

    def __init__(self, seed, numbers=0):
        self.kinds, self.numbers = np.random.RandomState(seed), np.random.RandomState([seed, numbers])
        self.sequences = []

    def pick(self, items):
        return items[self.kinds.randint(len(items))]

    def chance(self, probability):
        return bool(self.kinds.rand() < probability)

    def sequence(self, kit, values):
        """Return a variation that goes through some values; an episode starts it anew, as one on MJX does."""
        self.sequences.append((kit.deterministic.Sequence(values), values))
        return self.sequences[-1][0]

    def number(self, low, high):
        return round(float(self.numbers.uniform(low, high)), 3)

    def vector(self, low, high, size=3):
        return self.numbers.uniform(low, high, size).round(3).tolist()


def robot(kit, draw, name, contacts, explicit):
    """Return a model: chains of bodies with joints, sites, actuators and sensors.

    With the integrator implicitfast, where ``explicit`` is False, MJX's own steps differ from C's where forces are
    clipped and tendons damped, by up to 1e-3: there is no such thing then.
    """
    root = kit.mjcf.RootElement(model=name)
    links = []
    for chain in range(draw.kinds.randint(1, 3)):
        parent = root.worldbody
        for link in range(draw.kinds.randint(1, 3)):
            pose = {"pos": draw.vector(-0.2, 0.2), "euler": draw.vector(-1, 1)}
            parent = parent.add("body", name=f"b{chain}{link}", **pose)
            links.append((f"{chain}{link}", draw.pick(("hinge", "hinge", "slide", "ball"))))
            _link(draw, parent, *links[-1], contacts)
    scalar = [tag for tag, joint in links if joint != "ball"]
    if len(scalar) > 1 and draw.chance(0.3):
        root.equality.add("joint", joint1=f"j{scalar[0]}", joint2=f"j{scalar[1]}", polycoef=[0, 0.5, 0.2, 0, 0])
    _tendon(draw, root, [tag for tag, _ in links], scalar, explicit)
    _actuators(draw, root, scalar, explicit)
    _sensors(draw, root, links)
    return root


def _link(draw, body, tag, kind, contacts):
    axis = {} if kind == "ball" else {"axis": draw.pick([[1, 0, 0], [0, 1, 0], [0, 0, 1]])}
    options = {"damping": draw.number(0.05, 0.5), "armature": draw.pick([0, 0.02]), "stiffness": draw.pick([0, 2.0])}
    options |= {"limited": True, "range": JOINTS[kind]} if draw.chance(0.3) else {}
    options |= {"frictionloss": 0.05} if draw.chance(0.2) else {}
    body.add("joint", name=f"j{tag}", type=kind, **options, **axis)
    shape = draw.pick(sorted(SHAPES))
    masks = {None: (0, 0), "all": (1, 1), "same": TOUCH[shape]}[contacts]
    options = {"condim": draw.pick([1, 3, 4]), "contype": masks[0], "conaffinity": masks[1]}
    body.add("geom", name=f"g{tag}", type=shape, size=SHAPES[shape], pos=draw.vector(-0.1, 0.1), **options)
    body.add("site", name=f"s{tag}", pos=draw.vector(-0.1, 0.1), euler=draw.vector(-1, 1))


def _tendon(draw, root, tags, scalar, explicit):
    options = {"name": "t", "stiffness": 3.0, "damping": 0.1 * explicit} if draw.chance(0.5) else {"name": "t"}
    kind = draw.pick((None, None, "fixed", "spatial"))
    if kind == "fixed" and scalar:
        tendon = root.tendon.add("fixed", **options)
        for tag in scalar:
            tendon.add("joint", joint=f"j{tag}", coef=draw.number(-1, 1))
    elif kind == "spatial" and len(tags) > 1:
        tendon = root.tendon.add("spatial", **options)
        for tag in (tags[0], tags[-1]):
            tendon.add("site", site=f"s{tag}")


def _actuators(draw, root, scalar, explicit):
    for tag in scalar:
        if draw.chance(0.7):
            kind, options = draw.pick(ACTUATORS)
            limits = {"ctrllimited": True, "ctrlrange": [-0.5, 0.5]} if draw.chance(0.4) else {}
            limits |= {"forcelimited": True, "forcerange": [-0.4, 0.4]} if draw.chance(0.2) and explicit else {}
            root.actuator.add(kind, name=f"a{tag}", joint=f"j{tag}", **options, **limits)
    if root.find_all("tendon") and draw.chance(0.7):
        root.actuator.add("motor", name="at", tendon="t", gear=[1.5])


def _sensors(draw, root, links):
    for tag, joint in links:
        kind = draw.pick((*AT_SITES, *OF_FRAMES, *OF_BODIES, *OF_JOINTS, "ballquat", "ballangvel"))
        if kind in (*OF_JOINTS, "ballquat", "ballangvel"):
            kind = draw.pick(("ballquat", "ballangvel") if joint == "ball" else OF_JOINTS)
            where = {"joint": f"j{tag}"}
        elif kind in OF_BODIES:
            where = {"body": f"b{tag}"}
        else:
            where = {"site": f"s{tag}"} if kind in AT_SITES else {"objtype": "site", "objname": f"s{tag}"}
        root.sensor.add(kind, name=f"n{tag}", **where)
    for actuator in root.find_all("actuator"):
        root.sensor.add(draw.pick(OF_ACTUATORS), name=f"n{actuator.name}", actuator=actuator.name)


def _variation(kit, draw, signed=False):
    d, noises, sequence = kit.distributions, kit.noises, draw.sequence(kit, [0.9, 1.2, 1.05])
    made = [
        noises.Multiplicative(d.Uniform(0.8, 1.2)), noises.Multiplicative(d.LogNormal(0.0, 0.1)),
        noises.Multiplicative(d.UniformChoice([0.9, 1.1])), noises.Multiplicative(kit.deterministic.Constant(1.05)),
        noises.Multiplicative(0.5 * d.Uniform(0.9, 1.0) + 0.5), noises.Multiplicative(sequence),
        noises.Multiplicative(d.Uniform(0.95, 1.05, single_sample=True), cumulative=True),
        noises.Additive(d.Normal(0.0, 0.01)), noises.Additive(d.BiasedRandomWalk(0.01, 5.0)),
        noises.Additive(d.UniformPointOnSphere(single_sample=True) * 0.01),
    ]  # fmt: skip
    return draw.pick(made if signed else made[:-3])


def _bind(kit, draw, variator, found, taken):
    """Bind some variations, not of what is taken; return whether MuJoCo derives constants from what they vary."""
    derived, before = False, list(taken)
    for _ in range(draw.kinds.randint(0, 4)):
        kind = draw.pick(sorted(VARIED))
        attribute = draw.pick(VARIED[kind])
        if found[kind]:
            variation, element = _variation(kit, draw, attribute == "pos"), draw.pick(found[kind])
            if any(element is e and attribute == a for e, a in before):
                continue
            variator.bind_attributes(element, **{attribute: variation})
            taken.append((element, attribute))
            derived = derived or attribute in DERIVED
    return derived


def _observable(kit, draw, found, varied):
    noises, steps = kit.noises, draw.sequence(kit, [0.1, -0.2, 0.3])

    def number(*values):
        return draw.sequence(kit, values) if draw.chance(0.3) and varied else values[0]

    direct = draw.chance(0.3)
    options = {
        "delay": number(*draw.kinds.randint(0, 8, 3).tolist()),
        "update_interval": number(*draw.kinds.randint(1, 5, 3).tolist()),
        "buffer_size": draw.pick([1, 2, 3]),
        "corruptor": draw.pick([None, None, noises.Additive(steps), noises.Multiplicative(1.5)]),
    }
    # dm_control cannot take the mean of what is a number, where buffers of one sample have no axis
    options["aggregator"] = draw.pick([None, "max", "min", "sum", *["mean", "median"] * (options["buffer_size"] > 1)])
    if direct:  # on MJX what is sampled at every read only draws as often as on C
        random = noises.Additive(kit.distributions.Uniform(-0.1, 0.1))
        options |= {"delay": 0, "update_interval": 1, "buffer_size": 1, "corruptor": draw.pick([None, random])}
        options["aggregator"] = None
    kind, attribute = draw.pick(OBSERVED)
    kind, attribute = (kind, attribute) if found[kind] else ("site", "xpos")
    elements = found[kind] if draw.chance(0.3) else draw.pick(found[kind])
    if draw.chance(0.2):
        return kit.observable.Generic(lambda physics: physics.bind(elements).__getattr__(attribute) * 2.0, **options)
    return kit.observable.MJCFFeature(attribute, elements, **options)


def _operations(draw, found, most):
    """Return hook -> what is done there: (elements, attribute, factor, offset)."""
    made = {}
    for hook in HOOKS:
        made[hook] = []
        for _ in range(draw.kinds.randint(0, most + 1)):
            kind, *rest = draw.pick(OPERATIONS)
            if kind in ("gravity", "vary") or found[kind]:
                made[hook].append((kind, draw.pick(found[kind]) if kind in found else None, *rest))
    return made


def _count_compensated(model):
    """Do for dm_control what ours does: have MuJoCo see that bodies are compensated, and keep all that it derives."""
    before = copy.copy(model)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for holder, old in ((model, before), (model.stat, before.stat)):
        for name, value in ((n, getattr(old, n)) for n in dir(old)):
            if isinstance(value, np.ndarray) and value.flags.writeable:
                getattr(holder, name)[...] = value
    model.stat.meaninertia, model.stat.meanmass = before.stat.meaninertia, before.stat.meanmass


class Operator:
    """Does in hooks what was drawn for them."""

    def __init__(self, kit):
        self.kit, self.own, self.once, self.often = kit, {}, None, None

    def values(self, physics):
        return getattr(physics, "variables", self.own)

    def apply(self, physics, random_state, variator, derived):
        variator.apply_variations(physics, random_state)
        if derived and self.kit.name == "dm_control":
            mujoco.mj_setConst(physics.model.ptr, mujoco.MjData(physics.model.ptr))
            physics.mark_as_dirty()

    def run(self, operations, physics, random_state):
        xp, values = getattr(physics, "np", np), self.values(physics)
        for kind, element, attribute, factor, offset in operations:
            if kind == "gravity":
                physics.model.opt.gravity = 0.9 * xp.asarray(physics.model.opt.gravity) + 0.02
                continue
            if kind == "vary":
                self.apply(physics, random_state, *self.often)
                continue
            if kind == "mocap" and self.kit.name == "dm_control":  # which computes nothing anew because of it
                physics.data.mocap_pos[:] = factor * physics.data.mocap_pos + offset
                physics.mark_as_dirty()
                continue
            bound = physics.bind(element)
            if attribute == "gravcomp" and self.kit.name == "dm_control":  # nor follows, where no body was compensated
                bound.gravcomp = factor * bound.gravcomp + offset
                if not physics.model.ngravcomp:
                    _count_compensated(physics.model.ptr)
                continue
            value = xp.asarray(getattr(bound, attribute)) + 0.0
            if factor is None:
                values["sum"] = values["sum"] + (value * value).sum()
            elif factor == "draw":
                setattr(bound, attribute, value + offset * random_state.normal(size=value.shape))
            elif factor == "part" and hasattr(physics, "write"):
                physics.write(element, attribute, offset, 0)
            elif factor == "part":
                getattr(bound, attribute)[0] = offset
            else:
                setattr(bound, attribute, factor * value + offset)


def _entity(kit, model, operator, operations):
    """Return an entity with hooks of its own."""

    class Robot(kit.composer.ModelWrapperEntity):
        pass

    def hook(name):
        def run(self, physics, random_state):
            operator.run(operations[name], physics, random_state)

        return run

    for name in HOOKS:
        setattr(Robot, name, hook(name))
    return Robot(model)


def _world(kit, draw, contacts, operator, seed=None, for_mjx=False):
    arena, models, entities = kit.composer.Arena(), [], []
    option = arena.mjcf_model.option
    option.noslip_iterations, option.tolerance, option.cone = 0, 1e-14, "pyramidal"
    option.integrator = draw.pick(["Euler", "implicitfast", "Euler", "implicitfast", "RK4"])
    if contacts:
        arena.mjcf_model.worldbody.add("geom", type="plane", size=[2, 2, 0.1], contype=1, conaffinity=1)
        option.cone = draw.pick(["pyramidal", "elliptic"])
    mocap = [arena.mjcf_model.worldbody.add("body", name="m", mocap=True)] if draw.chance(0.3) else []
    for body in mocap:
        body.add("site", name="ms", pos=[0.1, 0, 0])
    operations = [{name: [] for name in HOOKS} for _ in range(3)]
    for i in range(draw.kinds.randint(1, 3)):
        models.append(robot(kit, draw, f"r{i}", contacts, option.integrator != "implicitfast"))
        entities.append(_entity(kit, models[-1], operator, operations[i]))
        free = draw.chance(0.4)
        frame = arena.add_free_entity(entities[-1]) if free else arena.attach(entities[-1])
        height = (0.1, 0.3) if contacts else (0.8, 1.0)
        frame.pos = draw.vector([i, -0.2, height[0]], [i + 0.1, 0.2, height[1]])
    for geom in [g for m in models for g in m.find_all("geom")]:
        if contacts == "same" and option.cone == "elliptic" and geom.condim == 1:  # which MJX has no contacts for
            geom.condim = 3
    if seed is not None:
        explicit = option.integrator != "implicitfast"
        random_links.link(kit, seed, arena.mjcf_model, models, contacts, explicit, for_mjx)
    kinds = ("joint", "site", "geom", "actuator", "sensor", "body", "tendon")
    found = {kind: [e for m in models for e in m.find_all(kind)] for kind in kinds}
    for kind in ("actuator", "sensor", "tendon"):
        found[kind] += arena.mjcf_model.find_all(kind, exclude_attachments=True)
    found["body"] = [b for b in found["body"] if b.name and not b.name.endswith("/")]
    found["joint"] += [j for j in map(kit.mjcf.get_frame_freejoint, models) if j is not None]
    return arena, entities, {**found, "mocap": mocap}, operations


def make(kit, seed, contacts=None, varied=False, numbers=0, linked=False):
    """Return the task of a seed and options of its environment.

    Args:
        kit: The modules that it is made of.
        seed: Seed.
        contacts: None, "same": only those that MJX finds as C does, or "all".
        varied: Whether delays and intervals of observables vary from sample to sample, where dm_control shifts samples,
            and nothing is varied that is also set otherwise, which MJX starts from another value.
        numbers: Seed of the numbers in the model.
        linked: Whether there are elements that name elements of other models; "mjx": those that MJX has as C does.
    """
    draw, operator = Draw(seed, numbers), Operator(kit)
    arena, entities, found, operations = _world(
        kit, draw, contacts, operator, seed if linked else None, linked == "mjx"
    )
    for own in operations[: len(entities)]:
        own.update(_operations(draw, found, 1))
    observables = {f"o{i}": _observable(kit, draw, found, varied) for i in range(draw.kinds.randint(2, 6))}
    for i, name in enumerate(sorted(observables)):
        observables[name].enabled = True
        if i % 3 == 1:
            entities[0].observables.add_observable(name, observables.pop(name))
    of_task, once, often = (
        _operations(draw, found, 2),
        kit.variation.PhysicsVariator(),
        kit.variation.PhysicsVariator(),
    )
    written = [
        (o[1], o[2]) for made in (*operations, of_task) for done in made.values() for o in done if o[3] is not None
    ]
    for name, variator in (("once", once), ("often", often)):  # on MJX what varies starts from the compiled value
        taken = written if varied else []
        setattr(operator, name, (variator, _bind(kit, draw, variator, found, taken)))
    before = kit.variation.MJCFVariator()
    if draw.chance(0.4):
        before.bind_attributes(draw.pick(found["geom"]), density=kit.distributions.Uniform(500.0, 2000.0))
    limit, binds = draw.pick([None, None, 30.0, 300.0]), draw.chance(0.5)
    hooks = _hooks(kit, draw, operator, of_task, before, found["actuator"] if binds else [])
    task = _task(kit, hooks, arena, observables, limit)
    steps = int(draw.kinds.randint(1, 6))
    task.set_timesteps(control_timestep=0.002 * steps, physics_timestep=0.002)
    padding = kit.composer.ObservationPadding
    options = {
        "strip_singleton_obs_buffer_dim": draw.chance(0.5), "legacy_step": draw.chance(0.8),
        "delayed_observation_padding": draw.pick([padding.ZERO, padding.INITIAL_VALUE]),
    }  # fmt: skip
    return task, options


def _hooks(kit, draw, operator, operations, before, actuators):
    """Return the hooks of a task, a class to be mixed in."""
    number = draw.kinds.randint(1000)

    class Hooked:
        def initialize_episode_mjcf(self, random_state):
            # dm_control samples observables, which draws, before this runs first: hence numbers of its own
            before.apply_variations(np.random.RandomState(number))

        def initialize_episode(self, physics, random_state):
            if hasattr(random_state, "start"):
                random_state.start()
                for sequence, values in draw.sequences:
                    sequence.__init__(values)
            operator.values(physics)["sum"] = getattr(physics, "np", np).zeros(())
            operator.apply(physics, random_state, *operator.once)
            operator.run(operations["initialize_episode"], physics, random_state)

        def before_step(self, physics, action, random_state):
            if actuators:
                physics.bind(actuators).ctrl = action
            else:
                physics.set_control(action)
            operator.run(operations["before_step"], physics, random_state)

        def before_substep(self, physics, action, random_state):
            operator.run(operations["before_substep"], physics, random_state)

        def after_substep(self, physics, random_state):
            operator.run(operations["after_substep"], physics, random_state)

        def after_step(self, physics, random_state):
            operator.run(operations["after_step"], physics, random_state)

        def get_reward(self, physics):
            return operator.values(physics)["sum"] + physics.time()

        def get_discount(self, physics):
            return 1.0 - 0.1 * (operator.values(physics)["sum"] > 1.0)

    return Hooked


def _task(kit, hooks, arena, observables, limit):
    class Random(hooks, kit.composer.NullTask):
        @property
        def task_observables(self):
            return observables

        def should_terminate_episode(self, physics):
            return False if limit is None else self.get_reward(physics) > limit

    return Random(arena)
