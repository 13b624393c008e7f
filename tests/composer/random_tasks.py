"""Random tasks, built with dm_control's composer or with ours, and played on dm_control, on C and on MJX.

A task has bodies, joints, actuators, sensors, observables with delays, variations, and in every hook reads and writes
of bound attributes. ``python tests/composer/random_tasks.py 0 200`` plays the tasks of seeds 0 to 199 on dm_control and
on C, with ``--mjx`` on MJX in double precision too, and prints those whose streams differ.
"""

import argparse
import importlib
from types import SimpleNamespace

import numpy as np

STEPS = 12
JOINTS = ("hinge", "hinge", "slide", "ball")
SENSORS = ("accelerometer", "gyro", "velocimeter", "framepos", "subtreecom")
PARTS = ("composer", "mjcf", "observable", "variation", "deterministic")
PATHS = {"composer": "", "mjcf": ".mjcf", "observable": ".observation.observable", "variation": ".variation"}


def kit(name):
    """Return the modules of ``dm_control`` or ``sim2real`` that tasks are made of."""
    paths = {**PATHS, "deterministic": ".variation.deterministic"}
    found = {k: importlib.import_module(f"{name}.composer{v}") for k, v in paths.items() if k != "mjcf"}
    found["mjcf"] = importlib.import_module("dm_control.mjcf" if name == "dm_control" else f"{name}.composer.mjcf")
    return SimpleNamespace(name=name, **found)


def vector(random, low, high, size=3):
    return random.uniform(low, high, size).round(3).tolist()


def robot(kit, random, name, contacts):
    """Return a model: chains of bodies with joints, sites, actuators and sensors."""
    root = kit.mjcf.RootElement(model=name)
    touch = {} if contacts else {"contype": 0, "conaffinity": 0}
    links = []
    for chain in range(random.randint(1, 3)):
        parent = root.worldbody
        for link in range(random.randint(1, 3)):
            parent = parent.add(
                "body", name=f"b{chain}{link}", pos=vector(random, -0.2, 0.2), euler=vector(random, -1, 1)
            )
            kind = JOINTS[random.randint(len(JOINTS))]
            axis = {} if kind == "ball" else {"axis": [[1, 0, 0], [0, 1, 0], [0, 0, 1]][random.randint(3)]}
            damping, armature = random.uniform(0.05, 0.5), random.choice([0, 0.02])
            options = {"stiffness": random.choice([0, 2.0]), "damping": damping, "armature": armature, **axis}
            parent.add("joint", name=f"j{chain}{link}", type=kind, **options)
            shape = [("sphere", [0.05]), ("capsule", [0.03, 0.08]), ("box", [0.05, 0.06, 0.04])][random.randint(3)]
            parent.add(
                "geom", name=f"g{chain}{link}", type=shape[0], size=shape[1], pos=vector(random, -0.1, 0.1), **touch
            )
            parent.add("site", name=f"s{chain}{link}", pos=vector(random, -0.1, 0.1))
            links.append((f"{chain}{link}", kind))
    for tag, kind in links:
        if kind != "ball" and random.rand() < 0.7:
            act = random.randint(3)
            options = [{"gear": [2.0]}, {"kp": 5.0}, {"dyntype": "filter", "dynprm": [0.05], "gainprm": [1.5]}][act]
            root.actuator.add(("motor", "position", "general")[act], name=f"a{tag}", joint=f"j{tag}", **options)
        sensor = SENSORS[random.randint(len(SENSORS))]
        where = {"body": f"b{tag}"} if sensor == "subtreecom" else {"site": f"s{tag}"}
        where = {"objtype": "site", "objname": f"s{tag}"} if sensor == "framepos" else where
        root.sensor.add(sensor, name=f"n{tag}", **where)
    return root


def make(kit, seed, contacts=False):
    """Return the task of a seed."""
    random = np.random.RandomState(seed)
    arena = kit.composer.Arena()
    option = arena.mjcf_model.option
    option.noslip_iterations, option.cone, option.tolerance = 0, "pyramidal", 1e-14
    option.integrator = random.choice(["Euler", "implicitfast"])
    if contacts:
        arena.mjcf_model.worldbody.add("geom", type="plane", size=[2, 2, 0.1])
    models, frames = [], []
    for i in range(random.randint(1, 3)):
        models.append(robot(kit, random, f"r{i}", contacts))
        entity = kit.composer.ModelWrapperEntity(models[-1])
        free = random.rand() < 0.4
        frames.append(arena.add_free_entity(entity) if free else arena.attach(entity))
        frames[-1].pos = vector(random, [i, -0.2, 0.8], [i + 0.1, 0.2, 1.0])
    found = {
        kind: [e for m in models for e in m.find_all(kind)]
        for kind in ("joint", "site", "geom", "actuator", "sensor", "body")
    }
    found["body"] = [b for b in found["body"] if b.name and not b.name.endswith("/")]
    return _task(kit, random, arena, found)


def _observables(kit, random, found):
    made = {}
    for i in range(random.randint(2, 6)):
        kind, attribute = [("site", "xpos"), ("sensor", "sensordata"), ("joint", "qvel"), ("body", "xquat")][
            random.randint(4)
        ]
        options = {
            "delay": int(random.randint(0, 5)), "update_interval": int(random.randint(1, 4)),
            "buffer_size": int(random.randint(1, 4)), "aggregator": [None, "mean", "max"][random.randint(3)],
        }  # fmt: skip
        made[f"o{i}"] = kit.observable.MJCFFeature(attribute, found[kind][random.randint(len(found[kind]))], **options)
        made[f"o{i}"].enabled = True
    return made


def _operations(random, found):
    """Return hook -> what is read and written there: (kind, number, attribute, factor, offset)."""
    choices = [
        ("joint", "qvel", 0.9, 0.0), ("joint", "qfrc_applied", 0.0, 0.3), ("body", "xfrc_applied", 0.0, 0.2),
        ("site", "pos", 1.0, 0.01), ("geom", "friction", 1.0, 0.01), ("site", "xpos", None, None),
        ("sensor", "sensordata", None, None), ("joint", "qacc", None, None), ("geom", "rgba", 0.5, 0.1),
    ]  # fmt: skip
    hooks = ("initialize_episode", "before_step", "before_substep", "after_substep", "after_step")
    made = {}
    for hook in hooks:
        picked = [choices[random.randint(len(choices))] for _ in range(random.randint(0, 4))]
        made[hook] = [(kind, random.randint(len(found[kind])), *rest) for kind, *rest in picked]
    return made


def _task(kit, random, arena, found):
    observables, operations = _observables(kit, random, found), _operations(random, found)
    variator, constant = kit.variation.PhysicsVariator(), kit.deterministic.Constant
    for joint in found["joint"][:: random.randint(1, 3)]:
        variator.bind_attributes(joint, damping=constant(float(random.uniform(0.1, 0.6))))
    binds_controls, steps = random.rand() < 0.5, random.randint(1, 5)

    class Random(kit.composer.NullTask):
        own = None

        @property
        def task_observables(self):
            return observables

        def values(self, physics):
            if not hasattr(physics, "variables"):
                self.own = {} if self.own is None else self.own
                return self.own
            return physics.variables

        def run(self, hook, physics):
            values = self.values(physics)
            for kind, number, attribute, factor, offset in operations[hook]:
                bound = physics.bind(found[kind][number])
                value = getattr(physics, "np", np).asarray(getattr(bound, attribute)) + 0.0
                if factor is None:
                    values["sum"] = values["sum"] + (value * value).sum()
                else:
                    setattr(bound, attribute, factor * value + offset)

        def initialize_episode(self, physics, random_state):
            self.values(physics)["sum"] = getattr(physics, "np", np).zeros(())
            variator.apply_variations(physics, random_state)
            self.run("initialize_episode", physics)

        def before_step(self, physics, action, random_state):
            if binds_controls and found["actuator"]:
                physics.bind(found["actuator"]).ctrl = action
            else:
                physics.set_control(action)
            self.run("before_step", physics)

        def before_substep(self, physics, action, random_state):
            self.run("before_substep", physics)

        def after_substep(self, physics, random_state):
            self.run("after_substep", physics)

        def after_step(self, physics, random_state):
            self.run("after_step", physics)

        def get_reward(self, physics):
            return self.values(physics)["sum"]

    task = Random(arena)
    task.set_timesteps(control_timestep=0.002 * steps, physics_timestep=0.002)
    return task


def play(kit, seed, contacts=False):
    """Return the streams of a task on the C engine: observations and rewards, step by step, up to a physics error."""
    env = kit.composer.Environment(make(kit, seed, contacts), random_state=0)
    actions = np.random.RandomState(seed).uniform(-1, 1, (STEPS, env.action_spec().shape[0]))
    steps = [env.reset()]
    for action in actions:
        try:
            steps.append(env.step(action))
        except RuntimeError as error:
            if type(error).__name__ != "PhysicsError":
                raise
            break
    return [dict(s.observation) for s in steps], [s.reward for s in steps[1:]]


def play_on_mjx(seed, contacts=False):
    """Return the same from MJX; in double precision where JAX has it switched on."""
    import jax

    ours = kit("sim2real")
    env = ours.composer.MjxEnvironment(make(ours, seed, contacts))
    actions = np.random.RandomState(seed).uniform(-1, 1, (STEPS, env.model.nu))

    def all_steps(key, actions):
        start = env.reset(key)
        states = jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, start, actions)[1]
        return start.observation, states.observation, states.reward

    first, rest, rewards = jax.device_get(jax.jit(all_steps)(jax.random.key(0), actions))
    return [first, *({k: v[i] for k, v in rest.items()} for i in range(STEPS))], list(rewards)


def differ(a, b, tolerance):
    """Return what differs first between two plays by more than a tolerance, or None."""
    if len(a[0]) > len(b[0]):
        return f"only one of them had a physics error, at step {len(b[0])}"
    for i, (one, other) in enumerate(zip(a[0], b[0], strict=False)):
        for name in one:
            if not np.allclose(one[name], other[name], rtol=tolerance, atol=tolerance):
                return f"step {i}, {name}: {np.abs(np.asarray(one[name]) - other[name]).max():.1e}"
    for i, (one, other) in enumerate(zip(a[1], b[1], strict=False)):
        if not np.allclose(one, other, rtol=tolerance, atol=tolerance):
            return f"reward {i + 1}: {one} and {other}"
    return None


def main():
    """Play the tasks of some seeds; print what differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int)
    parser.add_argument("count", type=int)
    parser.add_argument("--mjx", action="store_true")
    parser.add_argument("--contacts", action="store_true")
    args = parser.parse_args()
    theirs, ours, bad = kit("dm_control"), kit("sim2real"), 0
    for seed in range(args.first, args.first + args.count):
        expected = play(theirs, seed, args.contacts)
        mine = play(ours, seed, args.contacts)
        found = {"C": differ(expected, mine, 1e-9) or differ(mine, expected, 1e-9)}
        if args.mjx:
            import jax

            with jax.enable_x64(True):
                found["MJX"] = differ(expected, play_on_mjx(seed, args.contacts), 1e-6 if args.contacts else 1e-9)
        wrong = {k: v for k, v in found.items() if v}
        bad += bool(wrong)
        if wrong:
            print(seed, wrong, flush=True)
    print(f"{args.count - bad} of {args.count} tasks agree", flush=True)


if __name__ == "__main__":
    main()
