"""``sim2real export policy``: a bundle for another machine, with an example that runs it on numpy alone."""

import shutil
from pathlib import Path

from sim2real.artifacts.bundle import BUNDLE
from sim2real.artifacts.run.run_folder import newest, pipeline_of
from sim2real.commands.config import ShipConfig
from sim2real.errors import UsageError
from sim2real.policy import standalone
from sim2real.policy.bundle import CONTRACT, GRAPH, WEIGHTS, load_bundle, read_contract
from sim2real.policy.contract import NetworkSpec
from sim2real.stages.pipeline.find_run import find_run, warn_of_stale
from sim2real.stages.pipeline.pipeline import available
from sim2real.stages.terminal.console import note, wrote

EXAMPLE = "run_policy.py"


def run(config: ShipConfig) -> Path:
    """Copy a bundle, write the example beside it, and return the folder.

    Raises:
        UsageError: The configuration names no policy, or the folder is not empty.
        Sim2RealError: The bundle is missing or damaged.
    """
    bundle = find_bundle(config)
    contract = load_bundle(bundle).contract  # refuses a damaged bundle
    plain = read_contract(bundle)[1] == NetworkSpec()
    out = config.to or Path(f"{bundle.resolve().parent.name}_policy")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out} is there and not empty", hint="name another folder with --to")
    # Copy the bundle, and the example that runs it in numpy.
    out.mkdir(parents=True, exist_ok=True)
    for name in (WEIGHTS, GRAPH, CONTRACT):
        shutil.copyfile(bundle / name, out / name)
    note(f"{contract.observation_size} observations to {len(contract.action)} actions at {contract.rate_hz:g} Hz")
    wrote(out / CONTRACT)
    if not plain:
        note(f"{EXAMPLE} runs clipped perceptrons alone: run {GRAPH} with onnxruntime, or sim2real.policy.load_bundle")
        return out
    shutil.copyfile(Path(standalone.__file__), out / EXAMPLE)
    wrote(out / EXAMPLE)
    return out


def find_bundle(config: ShipConfig) -> Path:
    """Return the folder of the bundle that the configuration names."""
    if (source := config.source) is None:
        raise UsageError(
            f"export needs a bundle, a run folder or a pipeline. Pipelines: {', '.join(sorted(available()))}",
            hint="sim2real export policy PIPELINE --to DIR",
        )
    for folder in (Path(source), Path(source) / BUNDLE):
        if (folder / CONTRACT).is_file():
            return folder
    if source in available():
        return warn_of_stale(newest(config.runs, source, "train")).output("bundle")
    run_dir = find_run(config.runs, source)
    return warn_of_stale(newest(config.runs, pipeline_of(run_dir), "train", run_dir)).output("bundle")
