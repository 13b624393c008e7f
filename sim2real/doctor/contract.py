"""The contract of a policy of any trainer: read from its export; the user is asked for missing facts."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

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
"""Kind of an observation term -> its names in exports of trainers."""
UNMEASURED = ("lin_vel", "other")
"""Kinds of terms that do not come from sensors."""
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
"""One number, a number for each joint, or a number for each pattern of joint names, as in Isaac Lab."""


class Term(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A term of the observation.

    Attributes:
        term: A kind of ``KINDS``, or one of its names; terms with other names can only be read from logged
            observations.
        size: Number of entries of one step; 0: the kind's usual number.
        scale: Factor from the quantity to the network's input.
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
        """The kind in ``KINDS``; ``other`` if no kind has the name."""
        return _OF_NAME.get(re.sub(r"[^a-z0-9]+", "_", self.term.lower()).strip("_"), "other")


class Contract(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What a policy expects of its robot.

    Attributes:
        joints: Names of the joints in the model, in the network's order.
        default_joint_pos: Shape ``(J,)`` [rad].
        action_scale: A target is ``default_joint_pos + action_scale * action`` [rad].
        kp, kd: Gains of the drives in training [N m/rad], [N m s/rad].
        drive: Kind of target: ``position`` for drives with gains, or ``torque``, ``action_scale * action`` [N m].
        delay_s: Longest time from a measurement to the motion that answers it, in training [s]; None: unknown, taken as
            0.
        mean, std, clip: Normaliser outside of the network: ``clip((observation - mean) / std)``; empty: none.
    """

    rate_hz: Annotated[float, msgspec.Meta(gt=0)]
    joints: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    default_joint_pos: Numbers
    action_scale: Numbers
    observation: Annotated[tuple[Term, ...], msgspec.Meta(min_length=1)]
    kp: Numbers = ()
    kd: Numbers = ()
    drive: Literal["position", "torque"] = "position"
    delay_s: float | None = None
    history_order: Literal["oldest first", "newest first"] = "oldest first"
    history_layout: Literal["term", "step"] = "term"
    mean: tuple[float, ...] = ()
    std: tuple[Annotated[float, msgspec.Meta(gt=0)], ...] = ()
    clip: float = 1e9

    def per_joint(self, name: str) -> np.ndarray:
        """Return a setting as a number for each joint, ``(J,)``."""
        setting = getattr(self, name)
        if isinstance(setting, dict):
            matched = [[v for p, v in setting.items() if re.fullmatch(p, joint)] for joint in self.joints]
            for joint, found in zip(self.joints, matched, strict=True):
                if len(found) != 1:
                    raise UsageError(f"{len(found) or 'no'} patterns of {name} match joint {joint}; exactly one must")
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

    def block(self, term: int, lag: int) -> slice:
        """Return the slice of the observation with a term of ``lag`` steps ago."""
        at = self.layout.index((term, lag))
        begin = sum(self.size_of(self.observation[t]) for t, _ in self.layout[:at])
        return slice(begin, begin + self.size_of(self.observation[term]))

    @property
    def size(self) -> int:
        """Number of entries of the observation."""
        return sum(self.size_of(term) * term.history for term in self.observation)


class Policy:
    """A network with its contract.

    Args:
        content: The bytes of an ONNX file whose only input and output are vectors; rows are computed together if it
            has a free batch axis.
    """

    def __init__(self, content: bytes, contract: Contract) -> None:
        self.content, self.contract = content, contract
        self._session = onnx_session(_batched(content))
        inputs, output = self._session.get_inputs(), self._session.get_outputs()[0]
        if len(inputs) != 1:
            names = ", ".join(i.name for i in inputs)
            raise UsageError(
                f"the network has {len(inputs)} inputs: {names}; the only input must be the observation",
                hint="export the actor without its memory or time step, as a function of the observation",
            )
        self._input, self._output = inputs[0].name, output.name
        takes, gives = (shape[-1] if shape else None for shape in (inputs[0].shape, output.shape))
        if isinstance(takes, int) and takes != contract.size:
            listed = ", ".join(f"{t.term} {t.history}x{contract.size_of(t)}" for t in contract.observation)
            raise UsageError(
                f"the network takes {takes} numbers, the contract's terms are {contract.size}: {listed}",
                hint="correct [[observation]]: terms, size or history",
            )
        if isinstance(gives, int) and gives != len(contract.joints):
            raise UsageError(f"the network gives {gives} actions, the contract has {len(contract.joints)} joints")

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions ``(N, A)`` for observations ``(N, O)`` before normalising."""
        return self.network(self.normalised(observations))

    def normalised(self, observations: np.ndarray) -> np.ndarray:
        """Return the network's input for observations."""
        c = self.contract
        return np.clip((observations - np.array(c.mean)) / np.array(c.std), -c.clip, c.clip) if c.mean else observations

    def network(self, x: np.ndarray) -> np.ndarray:
        """Return the network's output ``(N, A)``, float64, for normalised observations ``(N, O)``."""
        rows = np.ascontiguousarray(x, np.float32)
        run = lambda value: self._session.run([self._output], {self._input: value})[0]  # noqa: E731
        try:
            return np.asarray(run(rows), float).reshape(len(rows), -1)
        except Exception:  # the network reshapes its input to one row
            return np.asarray([run(row[None]) for row in rows], float).reshape(len(rows), -1)


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

    The bundle's actions are the network's, in its units and order, with bounds of 100.
    """
    import onnx
    from onnx import helper, numpy_helper

    from sim2real.policy.bundle import save_bundle
    from sim2real.policy.contract import ActionTerm, NetworkSpec, ObservationTerm, PolicyContract

    c, model = policy.contract, onnx.load_from_string(policy.content)
    graph, size, count = model.graph, policy.contract.size, len(policy.contract.joints)
    # The input and output get the bundle's names; the normaliser comes before the network.
    takes, gives = graph.input[0].name, graph.output[0].name
    constants = {"mean": c.mean or np.zeros(size), "std": c.std or np.ones(size), "low": -c.clip, "high": c.clip}
    graph.initializer.extend(
        numpy_helper.from_array(np.asarray(value, np.float32), f"sim2real_{name}") for name, value in constants.items()
    )
    nodes = [
        helper.make_node("Sub", ["observation", "sim2real_mean"], ["sim2real_a"]),
        helper.make_node("Div", ["sim2real_a", "sim2real_std"], ["sim2real_b"]),
        helper.make_node("Clip", ["sim2real_b", "sim2real_low", "sim2real_high"], [takes]),
        *graph.node,
        helper.make_node("Identity", [gives], ["action"]),
    ]
    del graph.node[:]
    graph.node.extend(nodes)
    for value, name, length in ((graph.input[0], "observation", size), (graph.output[0], "action", count)):
        value.CopyFrom(helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, length]))
    terms = tuple(ObservationTerm(t.term, ("1",) * c.size_of(t), t.history) for t in c.observation)
    actions = tuple(ActionTerm(joint, "1", -_BOUND, _BOUND) for joint in c.joints)
    about = PolicyContract(terms, actions, c.rate_hz, {} if c.delay_s is None else {"round_trip": c.delay_s})
    weights = {"mean": np.zeros(size), "std": np.ones(size), "low": np.full(count, -_BOUND),
               "high": np.full(count, _BOUND), "log_std": np.zeros(count)}  # fmt: skip
    save_bundle(folder, weights, about, spec=NetworkSpec("foreign:onnx"), graph=model.SerializeToString())
    inside = msgspec.structs.replace(c, mean=(), std=())
    (folder / FILE).write_text(contract_toml(inside), encoding="utf-8")
    return folder


_BOUND = 100.0
"""Bound of the actions of a bundle from another trainer, whose networks state none."""


# -- reading


def read_policy(
    policy: Path, description: Path | None = None, model_joints: Sequence[str] = (), out: Path = Path()
) -> Policy:
    """Read a policy and all available facts about it.

    Args:
        policy: An ONNX file, or the folder of a bundle.
        description: A contract file (TOML), ``deploy.yaml`` of a Unitree deployment, or ``env.yaml`` of Isaac Lab.
        model_joints: The names of the model's driven joints, in the order of the robot's motors.
        out: Folder of the contract file with questions.

    Raises:
        UsageError: A file cannot be read, or facts are missing: then a contract file with questions is written.
    """
    content, facts = _read_export(policy)
    if description is not None:
        facts |= _read_description(description, model_joints)
    questions = {name: text for name, text in _QUESTIONS.items() if name not in facts}
    for name in ("kp", "kd"):
        # Do not ask for gains if the model has them or targets are torques; ask again if an exporter wrote
        # placeholders.
        why = _no_gain(name, facts[name]) if name in facts else ""
        if why:
            del facts[name]
            if facts.get("drive") != "torque":
                questions[name] = f"{why}: {_QUESTIONS[name]}"
        else:
            questions.pop(name, None)
    if questions:
        path = out / FILE
        path.write_text(contract_toml(facts, questions), encoding="utf-8")
        raise UsageError(
            f"facts about {policy} are missing; {path} has {len(questions)} open questions:\n"
            + "\n".join(f"  {name}: {text}" for name, text in questions.items()),
            hint=f"answer them in the file, and repeat the command with --contract {path}",
        )
    where = str(description or policy)
    try:
        contract = msgspec.convert(facts, Contract, strict=False)
    except msgspec.ValidationError as error:
        raise UsageError(f"{where}: {error}", hint="the guide 'Doctor' has a contract with every key") from None
    if {len(contract.mean), len(contract.std)} not in ({0}, {contract.size}):
        raise UsageError(f"{where}: mean and std need {contract.size} numbers, as the observation has")
    return Policy(content, contract)


def _no_gain(name: str, given: Json) -> str:
    """Return why numbers are no gains; all 0, or all 1.000, are placeholders of an exporter."""
    try:
        numbers = np.atleast_1d(list(given.values()) if isinstance(given, dict) else given).astype(float)
    except (TypeError, ValueError):
        return ""  # refused later by the contract's types
    if not numbers.size:
        return ""
    if (np.abs(numbers) < 5e-4).all() or (name == "kp" and (np.abs(numbers - 1.0) < 5e-4).all()):
        return f"the export's {numbers[0]:.3f} everywhere is a placeholder, no gain"
    return f"the export's {min(numbers):g} is below 0" if min(numbers) < 0 else ""


def contract_toml(contract: Contract | Mapping[str, Json], questions: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a contract, or its known part, as TOML with a comment for each open question."""
    facts = msgspec.to_builtins(contract)
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


def _read_export(policy: Path) -> tuple[bytes, dict[str, Json]]:
    """Return the network's file, and what the export says about it."""
    if policy.is_dir():
        from sim2real.policy.bundle import GRAPH, read_contract

        bundle, _ = read_contract(policy)
        terms = [{"term": t.name, "size": t.size, "history": t.history} for t in bundle.observation]
        earlier = [t for t in terms if t["term"].startswith("earlier features")]
        terms = [t for t in terms if t not in earlier]
        for term in terms if earlier else ():  # a walking policy's history has all features except the command
            term["history"] += earlier[0]["history"] * (not term["term"].startswith("command"))
        facts: dict[str, Json] = {
            "rate_hz": bundle.rate_hz, "observation": terms, "history_order": "newest first",
            "history_layout": "step" if earlier else "term",
        }  # fmt: skip
        if trained := bundle.trained_s.get("round_trip_delay"):
            facts["delay_s"] = trained[1]
        return (policy / GRAPH).read_bytes(), facts
    import onnx

    try:
        content = policy.read_bytes()
        model = onnx.load_from_string(content)
    except OSError as error:
        raise UsageError(f"the policy {policy} cannot be read: {error.strerror}") from None
    except Exception:  # errors of protobuf have no common base class
        raise UsageError(
            f"{policy} is no ONNX file",
            hint="export the actor as ONNX: torch.onnx.export for Stable-Baselines3 and rsl_rl, jax2onnx for brax",
        ) from None
    return content, _facts_of_metadata({p.key: p.value for p in model.metadata_props})


_METADATA = {
    "default_joint_pos": "default_joint_pos", "action_scale": "action_scale", "kp": "joint_stiffness",
    "kd": "joint_damping", "rate_hz": "rate_hz", "delay_s": "delay_s", "period": "step_dt",
}  # fmt: skip
_TERM_METADATA = {"size": "observation_dims", "scale": "observation_terms_scale",
                  "history": "observation_terms_history_length|observation_history_lengths"}  # fmt: skip
"""Fact -> its key in the metadata that mjlab, Isaac Lab's motion tracking and their forks write into an ONNX."""


def _facts_of_metadata(data: Mapping[str, str]) -> dict[str, Json]:
    def numbers(keys: str) -> list[float]:
        key = next((k for k in keys.split("|") if k in data), "")
        try:
            return [float(v) for v in re.split(r"[\s,;\[\]()]+", data.get(key, "")) if v]
        except ValueError:
            raise UsageError(f"the metadata {key!r} of the ONNX file holds no numbers: {data[key][:60]}") from None

    found = {fact: values for fact, key in _METADATA.items() if (values := numbers(key))}
    facts: dict[str, Json] = {k: v[0] if k in ("rate_hz", "delay_s", "period") else v for k, v in found.items()}
    if "joint_names" in data:
        facts["joints"] = data["joint_names"].split(",")
    if "observation_names" in data:
        names = data["observation_names"].split(",")
        columns = {part: values for part, key in _TERM_METADATA.items() if len(values := numbers(key)) == len(names)}
        facts["observation"] = [
            _term(name, {part: values[i] for part, values in columns.items()}) for i, name in enumerate(names)
        ]
    return _with_rate(facts)


def _term(name: str, given: Mapping[str, Json]) -> dict[str, Json]:
    """Return a term of the observation from a trainer's description."""
    scale, term = given.get("scale"), dict[str, Json](term=name)
    if scale is not None:
        term["scale"] = scale if isinstance(scale, list) else float(scale)
    if size := given.get("size") or (len(scale) if isinstance(scale, list) else 0):
        term["size"] = int(size)
    return term | {"history": max(1, int(given.get("history") or 1))}


def _with_rate(facts: dict[str, Json]) -> dict[str, Json]:
    if "period" in facts:
        period_s = float(facts.pop("period"))
        facts["rate_hz"] = 1.0 / period_s if period_s > 0 else 0.0  # refused later
    return facts


_YAML = {
    "step_dt": {"period": "step_dt", "motors": "joint_ids_map",
                "default_joint_pos": "actions.*.offset|default_joint_pos",
                "action_scale": "actions.*.scale", "kp": "stiffness", "kd": "damping"},  # unitree_rl_lab
    "control_dt": {"period": "control_dt", "motors": "leg_joint2motor_idx|num_actions", "kp": "kps", "kd": "kds",
                   "default_joint_pos": "default_angles", "action_scale": "action_scale"},  # unitree_rl_gym
    "decimation": {"period": "sim.dt", "default_joint_pos": "scene.robot.init_state.joint_pos",
                   "action_scale": "actions.*.scale"},  # Isaac Lab
}  # fmt: skip
"""Key that identifies a format -> fact -> paths in the file; the first existing path counts."""


def _at(data: Json, paths: str) -> Json:
    """Return the value at the first existing path of ``a.b|c``; ``*``: the first entry with the rest."""
    for path in paths.split("|"):
        found: list[Json] = [data]
        for key in path.split("."):
            inside = [entry for entry in found if isinstance(entry, dict)]
            found = [v for e in inside for v in e.values()] if key == "*" else [e[key] for e in inside if key in e]
        if found and found[0] is not None:
            return found[0]
    raise KeyError(paths)


def _facts_of_yaml(data: Mapping[str, Json], model_joints: Sequence[str]) -> dict[str, Json]:
    form = next(key for key in _YAML if key in data)
    facts: dict[str, Json] = {fact: _at(data, path) for fact, path in _YAML[form].items()}
    motors = facts.pop("motors", [])
    motors = [int(m) for m in (range(motors) if isinstance(motors, int) else motors)]
    if motors and max(motors) < len(model_joints):
        facts["joints"] = [model_joints[m] for m in motors]
    if form == "step_dt":  # gains are in the order of the motors, positions in the network's order
        facts |= {name: [float(facts[name][m]) for m in motors] for name in ("kp", "kd")}
        terms = data["observations"]
    elif form == "control_dt":
        scales = {"ang_vel": "ang_vel_scale", "gravity": "", "command": "cmd_scale", "joint_pos": "dof_pos_scale",
                  "joint_vel": "dof_vel_scale", "last_action": ""}  # fmt: skip
        terms: dict[str, Json] = {term: {"scale": data[key]} if key else {} for term, key in scales.items()}
        if (phase := int(data["num_obs"]) - 9 - 3 * int(data["num_actions"])) > 0:
            terms["phase"] = {"size": phase}
    else:  # the order of the joints is the simulator's and not in the file: ask for it
        facts["period"] = float(facts["period"]) * int(data["decimation"])
        group = data["observations"]["policy"]
        shared = {} if group.get("history_length") is None else {"history_length": group["history_length"]}
        terms = {name: term | shared for name, term in group.items() if isinstance(term, dict) and "func" in term}
        for name, key in (("kp", "stiffness"), ("kd", "damping")):
            gains: dict[str, float] = {}
            for drives in [g for g in data["scene"]["robot"]["actuators"].values() if isinstance(g, dict)]:
                own = drives.get(key)
                of = own if isinstance(own, dict) else dict.fromkeys(drives["joint_names_expr"], own)
                gains |= {pattern: float(value) for pattern, value in of.items() if value is not None}
            facts |= {name: gains} if gains else {}
    facts["observation"] = [_term(name, {**t, "history": t.get("history_length")}) for name, t in terms.items()]
    return _with_rate(facts)


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
        return facts
    import yaml

    loader = type("Loader", (yaml.SafeLoader,), {})  # Isaac Lab's files have tags of Python types
    loader.add_multi_constructor("tag:yaml.org,2002:python/", _plain_node)
    try:
        data = yaml.load(text, loader)
    except yaml.YAMLError as error:
        raise UsageError(f"{path} is no YAML: {error}") from None
    if not isinstance(data, dict) or not any(key in data for key in _YAML):
        raise UsageError(
            f"{path} has neither step_dt (unitree_rl_lab), control_dt (unitree_rl_gym) nor decimation (Isaac Lab)",
            hint=f"write a {FILE} instead: the guide 'Doctor' has one",
        )
    try:
        return _facts_of_yaml(data, model_joints)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise UsageError(f"{path} is malformed: {error!r}") from None


def _plain_node(loader: Any, suffix: str, node: Any) -> Json:
    import yaml

    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else suffix
