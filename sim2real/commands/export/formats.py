"""The formats of an export: one file each, or a folder."""

from collections.abc import Mapping
from pathlib import Path

from sim2real.artifacts.files import write_json
from sim2real.artifacts.identification import Identification
from sim2real.commands.export.card import write_model_card
from sim2real.errors import UsageError
from sim2real.identify.export.document import json_document
from sim2real.identify.export.isaaclab import isaaclab_source
from sim2real.identify.export.mjcf import Late, late_mjcf
from sim2real.identify.export.mjlab import mjlab_source
from sim2real.identify.export.terms import find_delays, find_terms, values_of
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.terminal.console import note

FILES = {"mjcf": "identified.xml", "mjlab": "mjlab.py", "isaaclab": "isaaclab.py", "json": "identified.json",
          "card": "card"}  # fmt: skip
_PLAIN = {"gain", "stiffness", "damping", "viscous", "coulomb", "armature", "gravity", "delay"}
"""Leaves of parameters that have a counterpart in MuJoCo's joints and drives."""


def write(
    to: str,
    out: Path,
    identification: Identification,
    robot: RecordedRobot,
    model: IdentifiableModel,
    about: list[tuple[str, str]],
    run_dir: Path | None = None,
) -> None:
    """Write one file, or the folder of a card.

    Args:
        to: As in ``export``.
        run_dir: Folder of the run, in which a card looks for the log.
    """
    table = model.parameters
    # Put the estimates into the robot's model.
    sides = {p.name: p.side for p in table}
    # Optional terms that were not identified have their nominal values, which switch them off.
    off = {p.name: p.nominal for p in table}
    text = robot.identified_mjcf({**off, **values_of(identification)})
    terms = None if text is None else find_terms(identification, lambda values: _text(robot, {**off, **values}), sides)
    # Write the format: JSON needs no model, the others need one.
    if to == "json":
        write_json(out, json_document(identification, terms, find_delays(identification, sides), about))
        return
    if to == "card":
        write_model_card(out, identification, robot, model, terms, about, run_dir)
        return
    if text is None or terms is None:
        raise _no_model(identification, table, to)
    if terms.unexpressed:
        note(f"not expressed in {to}: {', '.join(terms.unexpressed)}")
        about = [*about, ("not expressed", ", ".join(terms.unexpressed))]
    if to == "mjcf":
        content = late_mjcf(text, terms, Late(robot.export_lead_s, robot.profile_rad_s), about)
    else:
        source = mjlab_source if to == "mjlab" else isaaclab_source
        content = source(
            terms, f"Actuators and randomisation of {identification.pipeline!r}, as sim2real identified them.", about
        )
    out.write_text(content, encoding="utf-8")


def _text(robot: RecordedRobot, values: Mapping[str, float]) -> str:
    text = robot.identified_mjcf(values)
    if text is None:
        raise UsageError(f"robot {type(robot).__name__} has a MuJoCo model for some values and none for others")
    return text


def _no_model(identification: Identification, table: ParameterTable, to: str) -> UsageError:
    """Return the error for a robot whose world is not MuJoCo's: it names what an MJCF would lack."""
    leaves = {p.name: str(p.leaf).rpartition(".")[2].partition("[")[0] for p in table if p.leaf}
    lost = [p.name for p in identification.parameters if leaves.get(p.name.partition("@")[0], "delay") not in _PLAIN]
    return UsageError(
        f"the world of pipeline {identification.pipeline!r} is not MuJoCo's, so there is no model to export to "
        f"{to}. Joints and drives of MuJoCo's have nothing for: {', '.join(lost) or 'its equations of motion'}",
        hint="--to json has all parameters, their intervals and the posterior",
    )
