"""``sim2real doctor``: finds out why a policy works in simulation and fails on the robot."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from sim2real.commands import flags
from sim2real.errors import ERROR, UsageError
from sim2real.stages.flag import Flag
from sim2real.stages.terminal.console import note, progress, wrote


@dataclass(frozen=True)
class DoctorConfig:
    """Find out why a policy works in simulation and fails on the robot; without --log, check it before it moves."""

    policy: Annotated[Path | None, Flag("FILE")] = None
    """The policy: an ONNX file of any trainer, or the folder of a bundle."""
    log: Annotated[Path | None, Flag("FILE")] = None
    """Log of the deployment: a log of sim2real, or CSV, NPZ, JSON or a bag with a row for each step of the policy."""
    mjcf: Annotated[Path | None, Flag("ROBOT.xml")] = None
    """The model on which the policy was trained."""
    contract: Annotated[Path | None, Flag("FILE")] = None
    """Description of the policy's inputs and outputs: contract.toml, Unitree's deploy.yaml, or Isaac Lab's env.yaml."""
    sim: Annotated[Path | None, Flag("FILE")] = None
    """Log of the same policy in simulation, whose timing stands for the timing in training."""
    out: Path = Path("doctor")
    """Folder of the page, and of a contract file with questions."""
    bundle: Annotated[Path | None, Flag("FOLDER")] = None
    """Write the policy as a bundle, which deploy and other tools take."""
    json: bool = False
    """Print the diagnosis as JSON."""


def doctor(command: str, arguments: list[str]) -> None:
    """``sim2real doctor --policy POLICY.onnx --log LOG --mjcf ROBOT.xml [--contract FILE]``."""
    examples = (
        "doctor --policy policy.onnx --log real.mcap --mjcf robot.xml",
        "doctor --policy policy.onnx --mjcf robot.xml",
    )
    config = flags.parse(DoctorConfig(), arguments, f"sim2real {command}", *examples)
    data, lines, wrong = _answer(config)
    print(json.dumps(data, indent=2, default=float) if config.json else "\n".join(lines))
    if wrong:
        sys.exit(ERROR)


def _answer(config: DoctorConfig) -> tuple[dict[str, Any], list[str], bool]:
    """Return the diagnosis as data and as lines, and whether a fault was found; write the page or the bundle."""
    if config.policy is None or (config.log is None and config.mjcf is None and config.bundle is None):
        raise UsageError("doctor needs --policy, and --log of the robot or --mjcf of the model, or both")
    from sim2real.doctor.before import examine
    from sim2real.doctor.contract import read_policy, write_bundle
    from sim2real.doctor.diagnosis import diagnose
    from sim2real.doctor.log import read_deployment
    from sim2real.doctor.plant import Drives, driven_joints
    from sim2real.doctor.report import write_diagnosis

    say = note if config.json else wrote
    config.out.mkdir(parents=True, exist_ok=True)
    joints = tuple(driven_joints(config.mjcf)) if config.mjcf else ()
    policy = read_policy(config.policy, config.contract, joints, config.out)
    wanted = policy.contract.joints
    if config.bundle is not None:
        say(str(write_bundle(config.bundle, policy)))
    drives = Drives(config.mjcf, policy.contract) if config.mjcf else None
    if config.log is None and drives is None:
        return {"bundle": str(config.bundle)}, [f"{config.bundle} is a bundle"], False
    if config.log is None:
        assert drives is not None
        with progress(None, "let the policy act in the model"):
            data = examine(policy, drives)
        return data, [data["sentence"], *(f"- {line}" for line in data["lines"])], not data["sound"]
    log = read_deployment(config.log, wanted, joints, policy.contract.drive)
    sim = None if config.sim is None else read_deployment(config.sim, wanted, joints, policy.contract.drive)
    note(f"{len(log.t)} steps of the policy in {log.t[-1] - log.t[0]:.1f} s")
    with progress(None, "look for what is wrong"):
        found = diagnose(policy, log, drives, sim, joints)
    page = str(write_diagnosis(config.out, found, log, config.policy.stem))
    say(page)
    lines = [found.sentence, *(f"- {f.question}: {f.text}; {f.share:.0%} of this gap" for f in found.findings),
             *(f"- not asked: {question}: {why}" for question, why in found.skipped.items())]  # fmt: skip
    return found.to_dict() | {"page": page}, lines, bool(found.findings) or found.unexplained
