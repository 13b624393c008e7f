"""The topics of a log: their names, ROS message types and byte layouts."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import named_leaves
from sim2real.log.cdr import ROS_TYPES, CdrConstant, CdrField, Layout, length, text
from sim2real.types import Json, PyTree

STEP_FIELDS = ("seq", "scheduled", "start", "woken", "ts_overwrite", "end", "drift")
MESSAGE_FIELDS = ("seq_out", "seq_in")
_INT64 = np.dtype("<i8")
_RULE = "=" * 80
_JOINT_STATE_TEXT = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    f"{_RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)


@dataclass(frozen=True)
class Topic:
    """A channel of the log.

    Attributes:
        name: The topic, e.g. ``/node/output``.
        schema_text: Definition of the message type, in ``ros2msg`` format.
        layout: Byte layout of the message type.
        metadata: The channel's metadata: role, original names of node and input, and fields with original names.
    """

    name: str
    schema: str
    schema_text: str
    layout: Layout
    metadata: Mapping[str, str]


@dataclass(frozen=True)
class JointSource:
    """The source of the joint states of one node.

    Attributes:
        topic: The topic of joint states; its layout has the names of this node's joints.
        picks: For each of position, velocity and effort: ``(leaf, element)`` of every joint in the node's output; leaf
            is -1 if the joint lacks the quantity. Empty if all joints lack it.
    """

    topic: Topic
    picks: tuple[tuple[tuple[int, int], ...], ...]


def snake(name: str) -> str:
    """Convert a name to ROS's form: ``lower_snake_case``, starting with a letter."""
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name)
    result = re.sub(r"[^A-Za-z0-9]+", "_", spaced).strip("_").lower()
    return result if result[:1].isalpha() else f"field_{result}".rstrip("_")


def output_topic(node: str, example: PyTree, units: Mapping[str, str] | None = None) -> Topic:
    """Return the topic of a node's output.

    Args:
        units: Field, or entry of one (``"aim[0]"``) -> unit.

    Raises:
        Sim2RealError: Two leaves get the same name, or a leaf has a dtype that ROS lacks.
    """
    # Describe each leaf by name, type, shape and unit.
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(example).items()}
    names = unique_names(arrays, f"the output of node {node!r}", "field")
    described = [
        {"name": names[original], "original": original, "dtype": a.dtype.str, "shape": list(a.shape)}
        for original, a in arrays.items()
    ]
    for entry, array in zip(described, arrays.values(), strict=True):
        if unit := _unit(entry["original"], array.size, units or {}):
            entry["unit"] = unit
    # Write the same as a ROS message definition; units and shapes are comments.
    lines = []
    for entry in described:
        part = _field(entry)
        count = f"[{part.size}]" if part.shape else ""
        notes = [f"{entry['original']}, shape {tuple(part.shape)}"] if len(part.shape) > 1 else []
        notes += [f"[{', '.join([unit] if isinstance(unit, str) else unit)}]"] if (unit := entry.get("unit")) else []
        note = f"  # {' '.join(notes)}" if notes else ""
        if part.size:
            lines.append(f"{ROS_TYPES[part.dtype.str[1:]]}{count} {entry['name']}{note}\n")
    return Topic(
        f"/{snake(node)}/output",
        f"sim2real_msgs/msg/{_camel(node)}Output",
        "".join(lines),
        layout_of_fields(described),
        {"role": "output", "node": node, "fields": json.dumps(described)},
    )


def layout_of_fields(described: Sequence[Mapping[str, Json]]) -> Layout:
    """Return the layout of an output from ``fields`` in its channel's metadata; its fields have the original names."""
    return Layout(part for entry in described if (part := _field(entry)).size)


def units_of_fields(described: Sequence[Mapping[str, Json]]) -> dict[str, str]:
    """Return field or entry (``"aim[0]"``) -> unit, from ``fields`` in a channel's metadata."""
    units: dict[str, str] = {}
    for entry in described:
        unit, name = entry.get("unit"), entry["original"]
        if isinstance(unit, str):
            units[name] = unit
        elif isinstance(unit, list):
            units |= {f"{name}[{i}]": str(u) for i, u in enumerate(unit) if u}
    return units


def step_topic(node: str) -> Topic:
    """Return the topic of a node's step records."""
    fields = _scalars({name: "1" if name == "seq" else "us" for name in STEP_FIELDS})
    metadata = {"role": "step", "node": node, "unit": "1e-6 s from the episode's start", "fields": fields}
    return Topic(f"/{snake(node)}/step", "sim2real_msgs/msg/Step", _int64_text(STEP_FIELDS), STEP_LAYOUT, metadata)


def input_topic(node: str, input_name: str) -> Topic:
    """Return the topic of a connection's message records."""
    fields = _scalars(dict.fromkeys(MESSAGE_FIELDS, "1"))
    metadata = {"role": "input", "node": node, "input": input_name, "fields": fields}
    name = f"/{snake(node)}/inputs/{snake(input_name)}"
    return Topic(name, "sim2real_msgs/msg/Input", _int64_text(MESSAGE_FIELDS), MESSAGE_LAYOUT, metadata)


def joint_source(
    node: str, example: PyTree, joints: Mapping[str, Mapping[str, str]], units: Mapping[str, str] | None = None
) -> JointSource:
    """Return the source of the ``sensor_msgs/msg/JointState`` messages in a node's output.

    Args:
        joints: Joint -> quantity (``position``, ``velocity``, ``effort``) -> field of the output: ``"th"``, or
            ``"q[2]"`` for an element of the flattened field.
        units: Field, or entry of one -> unit.

    Raises:
        Sim2RealError: A quantity, a field or an element does not exist.
    """
    quantities = ("position", "velocity", "effort")
    known: dict[str, tuple[int, int]] = {}
    for leaf, (name, value) in enumerate(named_leaves(example).items()):
        known |= {f"{name}[{i}]": (leaf, i) for i in range(np.size(value))}
        if np.size(value) == 1:
            known[name] = leaf, 0
    for joint, sources in joints.items():
        for quantity, source in sources.items():
            if quantity not in quantities or source not in known:
                raise Sim2RealError(
                    f"joint {joint!r} reads {quantity} from {source!r} of node {node!r}. Available: "
                    f"{', '.join(quantities)}, from {', '.join(known)}"
                )
    # A message starts with the header and the joints' names, which are constants.
    picks: list[tuple[tuple[int, int], ...]] = []
    described: list[dict[str, Json]] = []
    parts: list[CdrConstant | CdrField] = [
        CdrField("sec", np.dtype("<i4")),
        CdrField("nanosec", np.dtype("<u4")),
        text(""),
    ]
    parts += [length(len(joints)), *(text(joint) for joint in joints)]
    # Add an array for each quantity that some joint has.
    for quantity in quantities:
        present = any(quantity in sources for sources in joints.values())
        elements = [known.get(s.get(quantity, ""), (-1, 0)) for s in joints.values()] if present else []
        picks.append(tuple(elements))
        parts.append(length(len(elements)))
        if elements:
            parts.append(CdrField(quantity, np.dtype("<f8"), (len(elements),)))
            entry = {"name": quantity, "original": quantity, "dtype": "<f8", "shape": [len(elements)]}
            sources = (s.get(quantity, "") for s in joints.values())
            joint_units = {f"{quantity}[{i}]": unit_of(source, units or {}) for i, source in enumerate(sources)}
            unit = _unit(quantity, len(elements), joint_units)
            described.append({**entry, "unit": unit} if unit else entry)
    metadata = {"role": "joint_states", "fields": json.dumps(described)}
    topic = Topic("/joint_states", "sensor_msgs/msg/JointState", _JOINT_STATE_TEXT, Layout(parts), metadata)
    return JointSource(topic, tuple(picks))


def unique_names(originals: Iterable[str], where: str, kind: str) -> dict[str, str]:
    """Return original name -> ROS name.

    Raises:
        Sim2RealError: Two names become the same ROS name.
    """
    taken: dict[str, str] = {}
    for original in originals:
        name = snake(original)
        if name in taken:
            raise Sim2RealError(
                f"{kind}s {taken[name]!r} and {original!r} in {where} are both {name!r} in the log",
                hint="ROS names are lower_snake_case: rename one of them",
            )
        taken[name] = original
    return {original: name for name, original in taken.items()}


def unit_of(name: str, units: Mapping[str, str]) -> str:
    """Return the unit of a field, or of an entry such as ``aim[0]``; "" if it is unknown."""
    return units.get(name, units.get(name.partition("[")[0], ""))


def _unit(name: str, size: int, units: Mapping[str, str]) -> str | list[str]:
    """Return the unit of a field; a list if its entries have different units; empty if it is unknown."""
    entries = [unit_of(f"{name}[{i}]", units) for i in range(size)]
    return entries if len(set(entries)) > 1 else "".join(set(entries))


def _scalars(units: Mapping[str, str]) -> str:
    """Return the metadata ``fields`` of a channel whose fields are integers."""
    common = {"dtype": _INT64.str, "shape": list[int]()}
    return json.dumps([{"name": name, "original": name, **common, "unit": unit} for name, unit in units.items()])


def _field(entry: Mapping[str, Json]) -> CdrField:
    return CdrField(entry["original"], np.dtype(entry["dtype"]), tuple(entry["shape"]))


def _camel(name: str) -> str:
    return "".join(part.capitalize() for part in snake(name).split("_"))


def _int64_text(names: Sequence[str]) -> str:
    return "".join(f"int64 {name}\n" for name in names)


STEP_LAYOUT = Layout(CdrField(name, _INT64) for name in STEP_FIELDS)
MESSAGE_LAYOUT = Layout(CdrField(name, _INT64) for name in MESSAGE_FIELDS)
