"""Which stages of a run are finished, and which of those are out of date: one function for all that ask.

``run`` and its iterations, ``info``, the report, ``deploy`` and the exports ask ``standing``. It compares hashes in
manifests and reads no other file: of a log of gigabytes it costs nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sim2real.artifacts.run.run_folder import STAGES, StageFolder, attempts, finished

TAKES = {"identify": ("record", "log"), "train": ("identify", "parameters"), "deploy": ("train", "bundle")}
"""Stage -> the stage before it, and the output of that which it is made from."""


@dataclass(frozen=True)
class Standing:
    """How a stage of a run stands.

    Attributes:
        newest: Its newest finished attempt.
        stale: Why that is out of date; "" where it is current.
    """

    newest: StageFolder
    stale: str = ""


def standing(run_dir: Path) -> dict[str, Standing]:
    """Return stage -> how it stands, in the order of the stages; a stage that never finished has no entry."""
    found: dict[str, Standing] = {}
    for stage in STAGES:
        if (done := finished(run_dir, stage)) is not None:
            found[stage] = Standing(done, why_stale(done, found))
    return found


def why_stale(attempt: StageFolder, found: Mapping[str, Standing]) -> str:
    """Return why a finished attempt is out of date; "" where it is current.

    A stage is current where it was made from the newest finished attempt at the stage before it, and that is current.
    """
    before, output = TAKES.get(attempt.stage, ("", ""))
    if before not in found:
        return ""  # the run began with this stage: its input comes from elsewhere
    source = found[before]
    name, own = attempt.folder.name, source.newest.folder.name
    if not _made_from(attempt, source.newest, output):
        return f"{name} was not made from {own}, the newest {before}: the hash of its {output} is another"
    return f"{name} was made from {own}, which is out of date" if source.stale else ""


def _made_from(attempt: StageFolder, source: StageFolder, output: str) -> bool:
    """Return whether one of a stage's inputs is an output of the stage before it."""
    if attempt.stage == "train" and (attempt.manifest.get("config") or {}).get("model") == "nominal":
        return True  # the nominal model needs no identification, so none makes its policy out of date
    inputs = {entry["sha256"] for entry in attempt.manifest["inputs"].values()}
    entry = source.manifest["outputs"].get(output)
    if entry is not None and entry["sha256"] in inputs:
        return True
    # An identification may be of logs that no recording of this run made: a deployment's own, or files of the user. It
    # is out of date once the robot is recorded again.
    if attempt.stage != "identify" or not inputs:
        return False
    recorded = {e["sha256"] for a in attempts(attempt.run_dir, "record") for e in a.manifest["outputs"].values()}
    return not inputs & recorded and str(attempt.manifest["started"]) > str(source.manifest["started"])
