"""What a policy of any trainer expects of its robot: read from its export, and asked for where the export is silent."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.mapping import toml_key, toml_value
from sim2real.policy.runner import onnx_session
from sim2real.types import Json

FILE = "contract.toml"
KINDS: Mapping[str, str] = {
    "ang_vel": "base_ang_vel ang_vel gyro imu_ang_vel angular_velocity",
    "gravity": "projected_gravity gravity gravity_vec gravity_in_the_base_s_axes",
    "lin_vel": "base_lin_vel lin_vel linear_velocity",
    "command": "velocity_commands keyboard_velocity_commands commands command cmd twist generated_commands goal target "
    "command_forwards_left_yaw_rate",
    "joint_pos": "joint_pos_rel joint_pos dof_pos qpos joint_position_less_stance positions joint_positions",
    "joint_vel": "joint_vel_rel joint_vel dof_vel qvel joint_velocity velocities joint_velocities",
    "last_action": "last_action actions action prev_action prev_actions previous_actions last_actions",
    "sin_joint_pos": "sin_joint_pos sin",
    "cos_joint_pos": "cos_joint_pos cos",
    "phase": "gait_phase phase",
}
"""Kind of an observation term -> its names in the exports of trainers."""
UNMEASURED = ("lin_vel", "other")
"""Kinds that the sensors of a robot alone do not give."""
_OF_NAME = {name: kind for kind, names in KINDS.items() for name in names.split()}
_OPEN = re.compile(r"^#\s*([a-z_]+) = .*\?", re.MULTILINE)
_QUESTIONS = {
    "rate_hz": "how many steps does the policy make in a second [Hz]?",
    "joints": "which joints has the action, by their names in the model, in the network's order?",
    "default_joint_pos": "at which angle of each joint is joint_pos 0, and the action 0 [rad]?",
    "action_scale": "by how much does the action 1 move a joint's target [rad]; one number, or one for each joint?",
    "kp": "which stiffness had the drives in training [N m/rad]; one number, or one for each joint?",
    "kd": "which damping had the drives in training [N m s/rad]; one number, or one for each joint?",
    "observation": 'which terms has the observation, such as [[observation]] term = "joint_pos"?',
}
Numbers = float | tuple[float, ...] | dict[str, float]
"""One number, one for each joint, or one for each pattern of joints' names, as Isaac Lab has them."""


class Term(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A term of the observation.

    Attributes:
        term: Its kind in ``KINDS``, or one of the names there; other names are read from a logged observation only.
        size: Number of entries of one step; 0: as the kind has it.
        scale: The network gets this multiple of the quantity.
        history: Number of steps in the observation.
        relative: Whether ``joint_pos`` counts from ``default_joint_pos``.
    """

    term: str
    size: int = 0
    scale: Numbers = 1.0
    history: int = 1
    relative: bool = True

    @property
    def kind(self) -> str:
        """Its kind in ``KINDS``; ``other`` if none has its name."""
        return _OF_NAME.get(re.sub(r"[^a-z0-9]+", "_", self.term.lower()).strip("_"), "other")


class Contract(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What a policy expects of its robot.

    Attributes:
        joints: Names in the model, in the network's order.
        default_joint_pos: Shape ``(J,)`` [rad].
        action_scale: A target is ``default_joint_pos + action_scale * action`` [rad].
        kp, kd: Gains of the drives in training [N m/rad], [N m s/rad].
        drive: What a target is: an angle for drives with gains, or a joint torque, ``action_scale * action`` [N m].
        delay_s: Longest time from a measurement to the motion that answers it, in training; None: unknown, taken as 0.
        mean, std, clip: Normaliser outside of the network: ``clip((observation - mean) / std)``; empty: none.
    """

    rate_hz: float
    joints: tuple[str, ...]
    default_joint_pos: Numbers
    action_scale: Numbers
    observation: tuple[Term, ...]
    kp: Numbers = ()
    kd: Numbers = ()
    drive: Literal["position", "torque"] = "position"
    delay_s: float | None = None
    history_order: Literal["oldest first", "newest first"] = "oldest first"
    history_layout: Literal["term", "step"] = "term"
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    clip: float = 1e9
    source: str = ""

    def per_joint(self, name: str) -> np.ndarray:
        """Return one of the settings with a number for each joint, ``(J,)``."""
        setting = getattr(self, name)
        if isinstance(setting, dict):
            matched = [[v for p, v in setting.items() if re.fullmatch(p, joint)] for joint in self.joints]
            if bare := [joint for joint, found in zip(self.joints, matched, strict=True) if len(found) != 1]:
                raise UsageError(f"the patterns of {name} match joint {bare[0]} not once")
            return np.array([found[0] for found in matched], float)
        value = np.asarray(setting, float)
        if value.size not in (1, len(self.joints)):
            raise UsageError(f"the contract has {value.size} numbers for {name}, and {len(self.joints)} joints")
        return np.broadcast_to(value.ravel(), len(self.joints)).copy()

    def size_of(self, term: Term) -> int:
        """Return the number of entries of one step of a term."""
        three = {"ang_vel": 3, "gravity": 3, "lin_vel": 3, "phase": 2, "command": 3, "other": 1}
        return term.size or three.get(term.kind, len(self.joints))

    @property
    def layout(self) -> list[tuple[int, int]]:
        """The blocks of the observation in their order: (index of the term, steps before the newest)."""
        longest = max(term.history for term in self.observation)
        lags = range(longest) if self.history_order == "newest first" else range(longest - 1, -1, -1)
        terms = list(enumerate(self.observation))
        if self.history_layout == "step":
            return [(i, lag) for lag in lags for i, term in terms if lag < term.history]
        return [(i, lag) for i, term in terms for lag in lags if lag < term.history]

    @property
    def size(self) -> int:
        """Number of entries of the observation."""
        return sum(self.size_of(term) * term.history for term in self.observation)


class Policy:
    """A network with its contract.

    Args:
        network: The bytes of an ONNX file with one input and one output that are vectors.
    """

    def __init__(self, network: bytes, contract: Contract) -> None:
        self.content, self.network, self.contract = network, Network(network), contract
        wanted = self.network.sizes
        if wanted[0] is not None and wanted[0] != contract.size:
            listed = ", ".join(f"{t.term} {t.history}x{contract.size_of(t)}" for t in contract.observation)
            raise UsageError(
                f"the network takes {wanted[0]} numbers, the contract's terms are {contract.size}: {listed}",
                hint="correct [[observation]]: terms, size or history",
            )
        if wanted[1] is not None and wanted[1] != len(contract.joints):
            raise UsageError(f"the network gives {wanted[1]} actions, the contract has {len(contract.joints)} joints")

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions ``(N, A)`` for observations ``(N, O)`` before normalising."""
        return self.network(self.normalised(observations))

    def normalised(self, observations: np.ndarray) -> np.ndarray:
        """Return observations as the network takes them."""
        c = self.contract
        if not c.mean:
            return observations
        return np.clip((observations - np.array(c.mean)) / np.array(c.std), -c.clip, c.clip)


class Network:
    """An ONNX file with one vector as input; rows are computed together if it has a free batch axis."""

    def __init__(self, content: bytes) -> None:
        self._session = onnx_session(_batched(content))
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            names = ", ".join(i.name for i in inputs)
            raise UsageError(
                f"the network has {len(inputs)} inputs: {names}; the doctor reads networks with the observation alone",
                hint="export the actor without its memory or time step, as a function of the observation",
            )
        self._input, self._output = inputs[0].name, self._session.get_outputs()[0].name
        shapes = inputs[0].shape, self._session.get_outputs()[0].shape
        self.sizes = tuple(s[-1] if s and isinstance(s[-1], int) else None for s in shapes)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the output ``(N, A)``, float64, for ``(N, O)``."""
        rows = np.ascontiguousarray(x, np.float32)
        try:
            return np.asarray(self._session.run([self._output], {self._input: rows})[0], float).reshape(len(rows), -1)
        except Exception:  # a network that reshapes to one row
            each = [self._session.run([self._output], {self._input: row[None]})[0] for row in rows]
            return np.asarray(each, float).reshape(len(rows), -1)


def _batched(content: bytes) -> bytes:
    """Return an ONNX file with a free first axis of its input and outputs."""
    import onnx

    model = onnx.load_from_string(content)
    for value in (*model.graph.input, *model.graph.output):
        axes = value.type.tensor_type.shape.dim
        if len(axes) == 2:
            axes[0].dim_param = "batch"
    return model.SerializeToString()


def write_bundle(folder: Path, policy: Policy) -> Path:
    """Write a policy of any trainer as a bundle, with its normaliser in the network; return the folder.

    The bundle's actions are those of the network, in its units and order, within bounds of 100.
    """
    import onnx
    from onnx import helper, numpy_helper

    from sim2real.policy.bundle import save_bundle
    from sim2real.policy.contract import ActionTerm, NetworkSpec, ObservationTerm, PolicyContract

    c, model = policy.contract, onnx.load_from_string(policy.content)
    graph = model.graph
    # The input and output get the bundle's names; constants of the normaliser come before the network.
    before, after = graph.input[0].name, graph.output[0].name
    steps = [("observation", "Identity", [])]
    if c.mean:
        for name, value in (("mean", c.mean), ("std", c.std), ("low", -c.clip), ("high", c.clip)):
            graph.initializer.append(numpy_helper.from_array(np.asarray(value, np.float32), f"sim2real_{name}"))
        steps = [("observation", "Sub", ["sim2real_mean"]), ("sim2real_a", "Div", ["sim2real_std"]),
                 ("sim2real_b", "Clip", ["sim2real_low", "sim2real_high"])]  # fmt: skip
    names = [*(source for source, _, _ in steps[1:]), before]
    nodes = [helper.make_node(kind, [source, *rest], [name])
             for (source, kind, rest), name in zip(steps, names, strict=True)]  # fmt: skip
    nodes += [*graph.node, helper.make_node("Identity", [after], ["action"])]
    del graph.node[:]
    graph.node.extend(nodes)
    for value, name, size in ((graph.input[0], "observation", c.size), (graph.output[0], "action", len(c.joints))):
        value.CopyFrom(helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, size]))
    terms = tuple(ObservationTerm(f"{t.term}", ("1",) * c.size_of(t), t.history) for t in c.observation)
    actions = tuple(ActionTerm(joint, "1", -_BOUND, _BOUND) for joint in c.joints)
    delays = {} if c.delay_s is None else {"round_trip": c.delay_s}
    about = PolicyContract(terms, actions, c.rate_hz, delays)
    size, count = c.size, len(actions)
    weights = {"mean": np.zeros(size), "std": np.ones(size), "low": np.full(count, -_BOUND),
               "high": np.full(count, _BOUND), "log_std": np.zeros(count)}  # fmt: skip
    spec = NetworkSpec("foreign:onnx")
    save_bundle(folder, weights, about, spec=spec, graph=model.SerializeToString())
    inside = msgspec.structs.replace(c, mean=(), std=())
    (folder / FILE).write_text(contract_toml(contract_facts(inside), {}), encoding="utf-8")
    return folder


_BOUND = 100.0
"""Largest action of a bundle of another trainer, whose networks state none."""


# -- reading


def read_policy(
    policy: Path, description: Path | None = None, model_joints: Sequence[str] = (), out: Path = Path()
) -> Policy:
    """Read a policy and all that is said about it.

    Args:
        policy: An ONNX file, or the folder of a bundle.
        description: A contract file (TOML), ``deploy.yaml`` of a Unitree deployment, or ``env.yaml`` of Isaac Lab.
        model_joints: The names of the model's driven joints, in the order of the robot's motors.
        out: Folder of the contract file with questions.

    Raises:
        UsageError: A file cannot be read, or something is not said; a contract file with questions is written.
    """
    content, facts = _read_export(policy)
    if description is not None:
        facts = facts | _read_description(description, model_joints)
    questions = {name: text for name, text in _QUESTIONS.items() if name not in facts}
    for name in ("kp", "kd"):
        if name in questions and (facts.get("drive") == "torque" or f"{name}_refused" not in facts):
            del questions[name]  # the model has gains, and a torque needs none
        elif name in questions:
            questions[name] = f"{facts[f'{name}_refused']}: {questions[name]}"
    known = {name: value for name, value in facts.items() if not name.endswith("_refused")}
    if questions:
        path = out / FILE
        path.write_text(contract_toml(known, questions), encoding="utf-8")
        raise UsageError(
            f"{policy} does not say everything; {path} has {len(questions)} open questions:\n"
            + "\n".join(f"  {name}: {text}" for name, text in questions.items()),
            hint=f"answer them in the file, and repeat the command with --contract {path}",
        )
    return Policy(content, _converted(known, str(description or policy)))


def _converted(known: Mapping[str, Json], where: str) -> Contract:
    try:
        contract = msgspec.convert(dict(known), Contract, strict=False)
    except msgspec.ValidationError as error:
        raise UsageError(f"{where}: {error}", hint="the guide 'Doctor' has a contract with every key") from None
    sizes = {len(contract.mean), len(contract.std)}
    if contract.rate_hz <= 0 or not contract.observation or not contract.joints:
        raise UsageError(f"{where}: rate_hz must be above 0, with at least one joint and one observation term")
    if sizes != {0} and sizes != {contract.size}:
        raise UsageError(f"{where}: mean and std need {contract.size} numbers, as the observation has")
    if min(contract.std, default=1.0) <= 0.0:
        raise UsageError(f"{where}: std must be above 0")
    return contract


def contract_toml(facts: Mapping[str, Json], questions: Mapping[str, str]) -> str:
    """Return a contract file with a comment for each open question."""
    lines = [f"# {name} = {text}" for name, text in questions.items()]
    for key, value in facts.items():
        if isinstance(value, dict):
            inner = ", ".join(f"{toml_key(k)} = {toml_value(v)}" for k, v in value.items())
            lines.append(f"{key} = {{ {inner} }}")
        elif key != "observation" and value not in ("", None, ()):
            lines.append(f"{key} = {toml_value(value)}")
    for term in facts.get("observation", ()):
        lines += ["", "[[observation]]", *(f"{k} = {toml_value(v)}" for k, v in term.items())]
    return "\n".join(lines) + "\n"


def contract_facts(contract: Contract) -> dict[str, Json]:
    """Return a contract as the facts that ``contract_toml`` writes."""
    return msgspec.to_builtins(contract)


def _read_export(policy: Path) -> tuple[bytes, dict[str, Json]]:
    """Return the network's file, and what the export says about it."""
    if policy.is_dir():
        from sim2real.policy.bundle import GRAPH, read_contract

        bundle, _ = read_contract(policy)
        terms = [
            {"term": t.name, "size": t.size, "history": t.history}
            for t in bundle.observation
            if not t.name.startswith("earlier features")
        ]
        earlier = [t for t in bundle.observation if t.name.startswith("earlier features")]
        for term in terms if earlier else ():  # a walking policy remembers all its features but the command
            term["history"] += earlier[0].history * (not term["term"].startswith("command"))
        facts: dict[str, Json] = {
            "rate_hz": bundle.rate_hz,
            "observation": terms,
            "history_order": "newest first",
            "history_layout": "step" if earlier else "term",
            "source": f"bundle {policy.name}",
        }
        if trained := bundle.trained_s.get("round_trip_delay"):
            facts["delay_s"] = trained[1]
        return (policy / GRAPH).read_bytes(), facts
    try:
        content = policy.read_bytes()
    except OSError as error:
        raise UsageError(f"the policy {policy} cannot be read: {error.strerror}") from None
    import onnx

    try:
        model = onnx.load_from_string(content)
    except Exception:  # protobuf's errors share no base class
        raise UsageError(
            f"{policy} is no ONNX file",
            hint="export the actor as ONNX: torch.onnx.export for Stable-Baselines3 and rsl_rl, jax2onnx for brax",
        ) from None
    return content, _facts_of_metadata({p.key: p.value for p in model.metadata_props})


def _facts_of_metadata(data: Mapping[str, str]) -> dict[str, Json]:
    """Return the facts in the metadata that mjlab, Isaac Lab's motion tracking and their forks write into an ONNX."""
    facts: dict[str, Json] = {}

    def floats(name: str) -> list[float]:
        try:
            return [float(v) for v in re.split(r"[\s,;\[\]()]+", data[name]) if v]
        except ValueError:
            raise UsageError(f"the metadata {name!r} of the ONNX file holds no numbers: {data[name][:60]}") from None

    if "joint_names" in data:
        facts["joints"] = data["joint_names"].split(",")
    for name in ("default_joint_pos", "action_scale"):
        if name in data and (numbers := floats(name)):
            facts[name] = numbers
    for ours, theirs in (("kp", "joint_stiffness"), ("kd", "joint_damping")):
        if theirs in data and (numbers := floats(theirs)):
            facts |= _gains(ours, numbers, theirs)
    if "observation_names" in data:
        names = data["observation_names"].split(",")
        several = lambda *keys: next((floats(k) for k in keys if k in data), [])  # noqa: E731
        sizes = several("observation_dims")
        histories = several("observation_terms_history_length", "observation_history_lengths")
        scales = several("observation_terms_scale")
        facts["observation"] = [
            {
                "term": name,
                **({"size": int(sizes[i])} if len(sizes) == len(names) else {}),
                **({"history": max(1, int(histories[i]))} if len(histories) == len(names) else {}),
                **({"scale": scales[i]} if len(scales) == len(names) else {}),
            }
            for i, name in enumerate(names)
        ]
    for name in ("rate_hz", "delay_s"):
        if name in data:
            facts[name] = float(data[name])
    if "step_dt" in data:
        facts["rate_hz"] = 1.0 / float(data["step_dt"])
    if facts:
        facts["source"] = "metadata of the ONNX file"
    return facts


def _gains(name: str, numbers: Sequence[float], theirs: str) -> dict[str, Json]:
    """Return gains as a fact; gains that are all 0, or all 1.000, are placeholders of an exporter, and refused."""
    if all(abs(v) < 5e-4 for v in numbers) or (name == "kp" and all(abs(v - 1.0) < 5e-4 for v in numbers)):
        return {f"{name}_refused": f"the export's {theirs} of {numbers[0]:.3f} everywhere is a placeholder, no gain"}
    if min(numbers) < 0:
        return {f"{name}_refused": f"the export's {theirs} of {min(numbers):g} is below 0"}
    return {name: list(numbers)}


def _read_description(path: Path, model_joints: Sequence[str]) -> dict[str, Json]:
    """Return the facts of a contract file, a ``deploy.yaml`` or an ``env.yaml``."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"the contract {path} cannot be read: {error}") from None
    if path.suffix == ".toml":
        try:
            facts = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise UsageError(f"{path} is no TOML: {error}") from None
        if question := _OPEN.search(text):
            raise UsageError(
                f"{path} has an open question: {question[0].lstrip('# ')}",
                hint=f"put the answer in place of the line, such as {question[1]} = ...",
            )
        refused = {}
        for name in ("kp", "kd"):
            if name in facts:
                given = facts[name]
                numbers = list(given.values()) if isinstance(given, dict) else np.atleast_1d(given).tolist()
                if name not in (checked := _gains(name, numbers, name)):
                    del facts[name]
                    refused |= checked
        return facts | refused
    import yaml

    loader = type("Loader", (yaml.SafeLoader,), {})  # Isaac Lab's files have tags of Python's own types
    loader.add_multi_constructor("tag:yaml.org,2002:python/", _plain_node)
    try:
        data = yaml.load(text, loader)
    except yaml.YAMLError as error:
        raise UsageError(f"{path} is no YAML: {error}") from None
    if not isinstance(data, dict):
        raise UsageError(f"{path} holds no keys")
    try:
        if "step_dt" in data:
            return _unitree_rl_lab(data, model_joints)
        if "control_dt" in data:
            return _unitree_rl_gym(data, model_joints)
        if "decimation" in data:
            return _isaac_lab(data)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise UsageError(f"{path} lacks a part of its format, or has it in another form: {error!r}") from None
    raise UsageError(
        f"{path} has neither step_dt (unitree_rl_lab), control_dt (unitree_rl_gym) nor decimation (Isaac Lab)",
        hint=f"write a {FILE} instead: the guide 'Doctor' has one",
    )


def _plain_node(loader: Any, suffix: str, node: Any) -> Json:
    import yaml

    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else suffix


def _joints_by_motor(motors: Sequence[int], model_joints: Sequence[str]) -> dict[str, Json]:
    """Return the joints of a list of motors' numbers, if the model has all of them."""
    if not model_joints or max(motors) >= len(model_joints):
        return {}
    return {"joints": [model_joints[m] for m in motors]}


def _unitree_rl_lab(data: Mapping[str, Json], model_joints: Sequence[str]) -> dict[str, Json]:
    motors = [int(m) for m in data["joint_ids_map"]]
    action = next(iter(data["actions"].values()))
    # Gains stand in the order of the motors, and positions in the network's.
    gains = {
        name: [float(data[key][m]) for m in motors] for name, key in (("kp", "stiffness"), ("kd", "damping"))
    }  # fmt: skip
    return {
        "rate_hz": 1.0 / float(data["step_dt"]),
        **_joints_by_motor(motors, model_joints),
        "default_joint_pos": action.get("offset") or data["default_joint_pos"],
        "action_scale": action["scale"],
        **_gains("kp", gains["kp"], "stiffness"),
        **_gains("kd", gains["kd"], "damping"),
        "observation": [
            {
                "term": name,
                "history": max(1, int(term.get("history_length") or 1)),
                **({"scale": term["scale"]} if term.get("scale") is not None else {}),
                **({"size": len(term["scale"])} if isinstance(term.get("scale"), list) else {}),
            }
            for name, term in data["observations"].items()
        ],
        "source": "deploy.yaml of unitree_rl_lab",
    }


def _unitree_rl_gym(data: Mapping[str, Json], model_joints: Sequence[str]) -> dict[str, Json]:
    motors = data.get("leg_joint2motor_idx", range(int(data["num_actions"])))
    phase = int(data["num_obs"]) - 9 - 3 * int(data["num_actions"])
    terms: list[dict[str, Json]] = [
        {"term": "ang_vel", "scale": float(data["ang_vel_scale"])},
        {"term": "gravity"},
        {"term": "command", "scale": data["cmd_scale"]},
        {"term": "joint_pos", "scale": float(data["dof_pos_scale"])},
        {"term": "joint_vel", "scale": float(data["dof_vel_scale"])},
        {"term": "last_action"},
        *([{"term": "phase", "size": phase}] if phase > 0 else []),
    ]
    return {
        "rate_hz": 1.0 / float(data["control_dt"]),
        **_joints_by_motor(list(motors), model_joints),
        "default_joint_pos": data["default_angles"],
        "action_scale": data["action_scale"],
        **_gains("kp", data["kps"], "kps"),
        **_gains("kd", data["kds"], "kds"),
        "observation": terms,
        "source": "configuration of unitree_rl_gym",
    }


def _isaac_lab(data: Mapping[str, Json]) -> dict[str, Json]:
    group = data["observations"]["policy"]
    shared = group.get("history_length")
    facts: dict[str, Json] = {
        "rate_hz": 1.0 / (float(data["sim"]["dt"]) * int(data["decimation"])),
        "observation": [
            {
                "term": name,
                "history": max(1, int(shared if shared is not None else term.get("history_length") or 1)),
                **({"scale": term["scale"]} if isinstance(term.get("scale"), int | float | list) else {}),
            }
            for name, term in group.items()
            if isinstance(term, dict) and "func" in term
        ],
        "source": "env.yaml of Isaac Lab",
    }
    action = next(a for a in data["actions"].values() if isinstance(a, dict) and "scale" in a)
    # The order of the joints is the simulator's, which the file does not have: it is asked. The rest is by name.
    robot = data["scene"]["robot"]
    groups = [g for g in robot["actuators"].values() if isinstance(g, dict)]
    facts |= {"action_scale": action["scale"], "default_joint_pos": robot["init_state"]["joint_pos"]}
    for name, key in (("kp", "stiffness"), ("kd", "damping")):
        gains: dict[str, float] = {}
        for group in groups:
            own = group.get(key)
            of = own if isinstance(own, dict) else dict.fromkeys(group["joint_names_expr"], own)
            gains |= {pattern: float(value) for pattern, value in of.items() if value is not None}
        checked = _gains(name, list(gains.values()), key) if gains else {}
        facts |= {name: gains} if name in checked else checked
    return facts
