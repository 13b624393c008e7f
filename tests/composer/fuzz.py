"""Plays random tasks on dm_control, on C and on MJX in double precision, and says where their streams differ."""

import functools

import numpy as np
from dm_env import specs
from random_tasks import kit, make

STEPS = 12
DRAWS = ("uniform", "normal", "lognormal", "exponential", "randint", "choice", "binomial")


class Numbers(np.random.RandomState):
    """From the start of an episode on, draws what a JAX key gives, so that all engines see the same numbers."""

    def __init__(self, key):
        super().__init__(0)
        self.key = key

    def start(self):
        import jax

        from sim2real.composer.physics.mjx.random import JaxRandomState

        state = JaxRandomState(jax.random.key(self.key))
        for name in DRAWS:
            setattr(self, name, functools.partial(self._draw, getattr(state, name)))

    @staticmethod
    def _draw(function, *args, **kwargs):
        return np.array(function(*args, **kwargs))[()]


def _as_ours(kit, task):
    """Let dm_control sample as often as we do, and pad with the first sample: rows of "Differences from dm_control"."""
    physics = kit.mjcf.Physics.from_mjcf_model(task.root_entity.mjcf_model)
    for observable in task.observables.values():
        value = np.asarray(observable._callable(physics)())
        known = {"array_spec": specs.Array(value.shape, value.dtype)}
        observable.__class__ = type("Known", (type(observable),), known)
        if observable.corruptor is None:
            observable.corruptor = lambda value, random_state: np.array(value)


def _actions(seed, size):
    return np.random.RandomState(seed).uniform(-1, 1, (STEPS, size))


def play(kit, seed, contacts=None, varied=False, key=0, episodes=1, numbers=0, linked=False):
    """Return the streams of a task on the C engine: observations, rewards, discounts; whether it is unstable."""
    task, options = make(kit, seed, contacts, varied, numbers, linked=linked)
    if kit.name == "dm_control":
        _as_ours(kit, task)
    env = kit.composer.Environment(task, random_state=Numbers(key), **options)
    found: list = [[], [], [], False]
    for _ in range(episodes):
        step = env.reset()
        found[0].append(dict(step.observation))
        for action in _actions(seed, env.action_spec().shape[0]):
            try:
                step = env.step(action)
            except RuntimeError as error:
                if type(error).__name__ != "PhysicsError":
                    raise
                found[3] = True
                return found
            for stream, value in zip(found, (dict(step.observation), step.reward, step.discount), strict=False):
                stream.append(value)
            if step.last():
                break
    return found


def play_on_mjx(seed, contacts=None, varied=False, keys=(0,), linked=False):
    """Return the streams of a task on MJX, one for each key."""
    import jax

    ours = kit("sim2real")
    task, options = make(ours, seed, contacts, varied, linked=linked)
    env = ours.composer.MjxEnvironment(task, **options)
    program, actions = jax.jit(_episode(env)), _actions(seed, env.model.nu)
    return [_streams(jax.device_get(program(jax.random.key(key), actions))) for key in keys]


def play_variants_on_mjx(seed, variants, contacts=None):
    """Return the streams of tasks that differ in the numbers of their models, as copies in one program."""
    import jax
    from mujoco import mjx

    ours = kit("sim2real")
    tasks = [make(ours, seed, contacts, True, numbers) for numbers in variants]
    env = ours.composer.MjxEnvironment(tasks[0][0], **tasks[0][1])
    for task, _ in tasks:
        task.initialize_episode_mjcf(None)
    models = [task.root_entity.mjcf_model.root_model.compile() for task, _ in tasks]
    leaves = [jax.tree_util.tree_leaves(mjx.put_model(m)) for m in models]
    stacked = jax.tree_util.tree_structure(env.mjx_model).unflatten(map(np.stack, zip(*leaves, strict=True)))
    starts = np.stack([m.qpos0 for m in models]), np.zeros((len(models), models[0].nv))
    keys = jax.vmap(jax.random.key)(np.array(variants))
    actions = _actions(seed, env.model.nu)
    program = jax.jit(jax.vmap(_episode(env), (0, None, 0, 0)))
    found = jax.device_get(program(keys, actions, stacked, starts))
    return [_streams(jax.tree_util.tree_map(lambda x, i=i: x[i], found)) for i in range(len(variants))]


def _episode(env):
    """Return a function that plays an episode: key and actions -> first observation, and all that follows."""
    import jax

    def play(key, actions, model=None, start=None):
        first = env.reset(key, model, start)
        states = jax.lax.scan(lambda s, a: (env.step(s, a, model),) * 2, first, actions)[1]
        return first.observation, (states.observation, states.reward, states.discount, states.done)

    return play


def _streams(found):
    first, (rest, rewards, discounts, done) = found
    last = int(np.argmax(done)) + 1 if done.any() else STEPS
    observations = [first, *({k: v[i] for k, v in rest.items()} for i in range(last))]
    return [observations, list(rewards[:last]), list(discounts[:last]), not discounts[:last].all()]


def differ(a, b):
    """Return the greatest deviation of two plays, relative above 1, and where it is; infinite where shapes differ."""
    worst = (0.0, "")
    common = min(len(a[0]), len(b[0]))
    if a[3] or b[3]:  # MuJoCo warns at the end of a step or at the start of the next one, MJX's copies end with it
        if abs(len(a[0]) - len(b[0])) > 1:
            return np.inf, f"unstable after {len(a[0]) - 1} steps and {len(b[0]) - 1}"
        a, b = ([p[0][: common - 1], p[1][: common - 2], p[2][: common - 2]] for p in (a, b))
    elif len(a[0]) != len(b[0]):
        return np.inf, f"{len(a[0]) - 1} steps and {len(b[0]) - 1}"
    for what, one, other in zip(("observation", "reward", "discount"), a[:3], b[:3], strict=True):
        for i, (x, y) in enumerate(zip(one, other, strict=True)):
            for name in x if isinstance(x, dict) else [""]:
                p, q = (np.asarray(v[name] if isinstance(v, dict) else v, float) for v in (x, y))
                if p.shape != q.shape:
                    return np.inf, f"{what} {name} {i}: shapes {p.shape} and {q.shape}"
                if not p.size:
                    continue
                gap = float((np.abs(p - q) / np.maximum(1.0, np.abs(q))).max())
                if not gap <= worst[0]:
                    worst = (
                        (np.inf if np.isnan(gap) else gap),
                        f"{what} {name} {i}: {p.ravel()[:6]} and {q.ravel()[:6]}",
                    )
    return worst


def compare(seed, contacts=None, engine="dm_control"):
    """Return the greatest deviation between what an engine and ours on C make of a task, and where it is."""
    ours = kit("sim2real")
    if engine == "mjx":
        mine = play_on_mjx(seed, contacts, True, (0, 1), linked="mjx")
        return max(differ(play(ours, seed, contacts, True, key, linked="mjx"), m) for key, m in enumerate(mine))
    return differ(*(play(kit(name), seed, contacts, episodes=2, linked=True) for name in ("dm_control", "sim2real")))
