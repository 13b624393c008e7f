"""``sim2real export``: estimates for other simulators, as JSON or a model card; a policy for a machine with numpy."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from sim2real.commands import flags
from sim2real.errors import UsageError
from sim2real.runtime import compilation_cache
from sim2real.stages.flag import Flag
from sim2real.stages.load import load_robot
from sim2real.stages.shared.find_run import find_bundle, find_parameters

Format = Literal["mjcf", "mjlab", "isaaclab", "json", "card", "policy"]
FILES = {"mjcf": "identified.xml", "mjlab": "mjlab.py", "isaaclab": "isaaclab.py", "json": "identified.json",
          "card": "card", "policy": "policy"}  # fmt: skip
EXAMPLE = "run_policy.py"


@dataclass(frozen=True)
class ExportConfig:
    """Write the estimates as a model of another simulator, or a policy for a machine that has only numpy."""

    source: Annotated[str, Flag("RUN|PIPELINE|FILE", positional=True, needed=True)] = ""
    """A run folder, a pipeline (its newest result is taken), a parameters.json, or the folder of a policy bundle."""
    to: Format = "mjcf"
    """Format: a model for MuJoCo, a Python file for mjlab or for Isaac Lab, everything as JSON; a model card: a folder
    with a page and a script that computes each figure again; a policy: its bundle with a script that runs it."""
    out: Annotated[Path | None, Flag("PATH")] = None
    """The file or folder to write; default: named after the pipeline, in the working directory."""
    runs: Path = Path("runs")
    """Folder of all runs."""


def export_(command: str, arguments: list[str]) -> None:
    """``sim2real export RUN|PIPELINE|FILE --to FORMAT``."""
    examples = ("export pendulum --to json", "export runs/arm/TIME --to mjcf --out arm.xml", "export go2 --to policy")
    config = flags.parse(ExportConfig(), arguments, f"sim2real {command}", *examples)
    compilation_cache.enable()
    run(config)


def run(config: ExportConfig) -> Path:
    """Write the file, print the parameters that it lacks, and return its path.

    Raises:
        UsageError: There is no such result, it was interrupted, or the target cannot hold the robot's model.
    """
    from sim2real.artifacts.identification import Identification
    from sim2real.stages.export import write_export  # imports JAX
    from sim2real.stages.terminal.console import wrote

    if config.to == "policy":
        return _export_policy(find_bundle(config.source, config.runs), config.out)
    if (Path(config.source) / "policy.json").is_file():
        raise UsageError(
            f"{config.source} is a policy bundle, and {config.to} is a format of estimates",
            hint=f"sim2real export {shlex.quote(config.source)} --to policy",
        )
    file = find_parameters(config.source, config.runs)
    identification = Identification.load(file)
    out = config.out or Path(f"{identification.pipeline}_{FILES[config.to]}")
    robot = load_robot(identification.pipeline)
    write_export(identification, robot, config.to, out, file.resolve().parent.parent)
    wrote(out)
    return out


def _export_policy(bundle: Path, out: Path | None) -> Path:
    """Copy a bundle, add a script that runs it, and return the folder.

    Raises:
        UsageError: The folder is not empty.
        Sim2RealError: The bundle is missing or damaged.
    """
    from sim2real.policy import standalone
    from sim2real.policy.bundle import CONTRACT, GRAPH, WEIGHTS, load_bundle, read_contract
    from sim2real.policy.contract import NetworkSpec
    from sim2real.stages.terminal.console import note, wrote

    contract = load_bundle(bundle).contract  # raises an error for a damaged bundle
    out = out or Path(f"{contract.robot or bundle.resolve().parent.name}_{FILES['policy']}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out} exists and is not empty", hint="name another folder with --out")
    out.mkdir(parents=True, exist_ok=True)
    for name in (WEIGHTS, GRAPH, CONTRACT):
        shutil.copyfile(bundle / name, out / name)
    note(f"{contract.observation_size} observations to {len(contract.action)} actions at {contract.rate_hz:g} Hz")
    wrote(out / CONTRACT)
    if read_contract(bundle)[1] != NetworkSpec():
        note(f"{EXAMPLE} runs clipped perceptrons alone: run {GRAPH} with onnxruntime, or sim2real.policy.load_bundle")
        return out
    shutil.copyfile(Path(standalone.__file__), out / EXAMPLE)
    wrote(out / EXAMPLE)
    return out
