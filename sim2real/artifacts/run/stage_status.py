"""The status of a run's stages: finished, and current or out of date.

``run`` and its iterations, ``info``, the report, ``deploy`` and the exports use ``stage_status``. It compares hashes in
manifests and reads no other file, so large logs cost no time.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sim2real.artifacts.run.run_folder import STAGES, StageFolder, attempts, finished

TAKES = {"identify": ("record", "log"), "train": ("identify", "parameters"), "deploy": ("train", "bundle")}
"""Stage -> the stage before it, and the output of that stage that it reads."""


@dataclass(frozen=True)
class StageStatus:
    """The status of a stage of a run.

    Attributes:
        stale: The reason if it is out of date; "" if it is current.
    """

    newest: StageFolder
    stale: str = ""


def stage_status(run_dir: Path) -> dict[str, StageStatus]:
    """Return stage -> status, in the order of the stages; a stage without a finished attempt has no entry."""
    status: dict[str, StageStatus] = {}
    for stage in STAGES:
        if (done := finished(run_dir, stage)) is not None:
            status[stage] = StageStatus(done, why_stale(done, status))
    return status


def why_stale(attempt: StageFolder, status: Mapping[str, StageStatus]) -> str:
    """Return why a finished attempt is out of date; "" if it is current.

    A stage is current if it was made from the newest finished attempt at the stage before it, and that is current.
    """
    before, output = TAKES.get(attempt.stage, ("", ""))
    if before not in status:
        return ""  # the run began with this stage: its input comes from elsewhere
    source = status[before]
    name, source_name = attempt.folder.name, source.newest.folder.name
    if not _made_from(attempt, source.newest, output):
        return f"{name} was not made from {source_name}, the newest {before}: the hashes of its {output} differ"
    return f"{name} was made from {source_name}, which is out of date" if source.stale else ""


def _made_from(attempt: StageFolder, source: StageFolder, output: str) -> bool:
    """Return whether one of a stage's inputs is an output of the stage before it."""
    if attempt.stage == "train" and (attempt.manifest.get("config") or {}).get("model") == "nominal":
        return True  # the nominal model needs no identification, so none makes its policy out of date
    inputs = {entry["sha256"] for entry in attempt.manifest["inputs"].values()}
    entry = source.manifest["outputs"].get(output)
    if entry is not None and entry["sha256"] in inputs:
        return True
    # An identification can read logs from outside of this run's recordings: of a deployment, or of the user. It is out
    # of date when the robot is recorded again.
    if attempt.stage != "identify" or not inputs:
        return False
    recorded = {e["sha256"] for a in attempts(attempt.run_dir, "record") for e in a.manifest["outputs"].values()}
    return not inputs & recorded and str(attempt.manifest["started"]) > str(source.manifest["started"])
