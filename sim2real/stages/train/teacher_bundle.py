"""Teachers: found among runs, compared with the robot of their student, and described in their own bundle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.run.run_folder import attempts
from sim2real.errors import UsageError
from sim2real.policy.contract import ObservationTerm, PolicyContract
from sim2real.stages.pipeline.find_run import find_run
from sim2real.train.networks.policy import Policy

_KNOWN = "simulation"
"""Name of the part of an observation that only simulation knows."""


def find_teacher(pipeline: str, target: str, root: Path) -> tuple[Bundle, Path]:
    """Return a teacher and its folder.

    Args:
        target: The folder of a bundle or of a training; or a run, by its path or name: its newest teacher.

    Raises:
        UsageError: There is no such run, or no teacher was trained in it.
        Sim2RealError: The bundle cannot be read.
    """
    path = Path(target)
    if any((path / name).is_file() for name in ("policy.json", "bundle/policy.json")):
        found = Bundle.load(path)
        return found, found.path or path
    run = find_run(root, target, pipeline)
    bundles = (Bundle.load(a.output("bundle")) for a in attempts(run, "train") if a.finished and "bundle" in a.outputs)
    for found in bundles:
        if found.spec.privileged and found.path is not None:
            return found, found.path
    raise UsageError(
        f"no teacher was trained in {run}",
        hint=f"train one with `sim2real train {pipeline} --ppo.teacher`, or name the folder of a policy's bundle",
    )


def teacher_of(bundle: Bundle, student: PolicyContract) -> Policy:
    """Return the policy of a teacher.

    Raises:
        UsageError: It sees or does something else than the student, besides what only simulation knows.
    """
    shown = [(t.name, t.units, t.history) for t in bundle.contract.observation if t.name != _KNOWN]
    seen = [(t.name, t.units, t.history) for t in student.observation]
    if shown != seen or bundle.contract.rate_hz != student.rate_hz:
        raise UsageError(
            f"the teacher in {bundle.path} sees {shown} at {bundle.contract.rate_hz:g} Hz, the student {seen} at "
            f"{student.rate_hz:g} Hz",
            hint="train the teacher on the student's robot",
        )
    return Policy.from_weights(bundle.weights, bundle.spec)


def as_taught(contract: PolicyContract, policy: Policy) -> PolicyContract:
    """Return the contract of a policy: that of a teacher names what only simulation knows."""
    if not policy.spec.privileged:
        return contract
    known = ObservationTerm(_KNOWN, ("?",) * policy.spec.privileged)
    return replace(contract, observation=(*contract.observation, known))
