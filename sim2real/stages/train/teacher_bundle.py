"""Teachers: the search among runs, the comparison with the student's robot, and the contract in their bundle."""

from dataclasses import replace
from pathlib import Path

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.run.run_folder import attempts
from sim2real.errors import UsageError
from sim2real.policy.contract import ObservationTerm, PolicyContract
from sim2real.stages.pipeline.find_run import find_run
from sim2real.train.networks.policy import Policy

_PRIVILEGED = "simulation"
"""Name of an observation's privileged part, which only the simulation has."""


def find_teacher(pipeline: str, target: str, root: Path) -> tuple[Bundle, Path]:
    """Return a teacher and its folder.

    Args:
        target: The folder of a bundle or of a training; or a run, by its path or name: its newest teacher.

    Raises:
        Sim2RealError: The bundle cannot be read.
    """
    path = Path(target)
    if any((path / name).is_file() for name in ("policy.json", "bundle/policy.json")):
        bundle = Bundle.load(path)
        return bundle, bundle.path or path
    run = find_run(root, target, pipeline)
    bundles = (Bundle.load(a.output("bundle")) for a in attempts(run, "train") if a.finished and "bundle" in a.outputs)
    for bundle in bundles:
        if bundle.spec.privileged and bundle.path is not None:
            return bundle, bundle.path
    raise UsageError(
        f"no teacher was trained in {run}",
        hint=f"train one with `sim2real train {pipeline} --ppo.teacher`, or name the folder of a policy's bundle",
    )


def teacher_policy(bundle: Bundle, student: PolicyContract) -> Policy:
    """Return the policy of a teacher."""
    terms = [(t.name, t.units, t.history) for t in bundle.contract.observation if t.name != _PRIVILEGED]
    student_terms = [(t.name, t.units, t.history) for t in student.observation]
    if terms != student_terms or bundle.contract.rate_hz != student.rate_hz:
        raise UsageError(
            f"the teacher in {bundle.path} observes {terms} at {bundle.contract.rate_hz:g} Hz, the student "
            f"{student_terms} at {student.rate_hz:g} Hz",
            hint="train the teacher on the student's robot",
        )
    return Policy.from_weights(bundle.weights, bundle.spec)


def policy_contract(contract: PolicyContract, policy: Policy) -> PolicyContract:
    """Return the contract of a policy; that of a teacher has the privileged part of the observation too."""
    if not policy.spec.privileged:
        return contract
    privileged = ObservationTerm(_PRIVILEGED, ("?",) * policy.spec.privileged)
    return replace(contract, observation=(*contract.observation, privileged))
