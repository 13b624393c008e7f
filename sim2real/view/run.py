"""What a run folder holds, as far as looking at it needs: stage folders, their manifests and their outputs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim2real.errors import Sim2RealError

STAGES = ("record", "identify", "train", "deploy")
_ENDED = ("finished", "dry run")
"""Status of what is shown, the better first."""


@dataclass(frozen=True)
class Artifact:
    """A stage's folder and what its manifest says.

    Attributes:
        folder: The folder.
        stage: Name of the stage.
        manifest: Empty where there is none to read.
    """

    folder: Path
    stage: str
    manifest: Mapping[str, Any]

    def output(self, name: str, usual: str) -> Path | None:
        """Return the path of an output that exists, or None.

        Args:
            name: What the manifest calls it.
            usual: The file's usual name: a stage asks for its page before its manifest lists any output.
        """
        entry = self.manifest.get("outputs", {}).get(name, {})
        path = self.folder / entry.get("path", usual)
        return path if path.exists() else None

    def need(self, name: str, usual: str) -> Path:
        """Return the path of an output.

        Raises:
            Sim2RealError: When it does not exist.
        """
        path = self.output(name, usual)
        if path is None:
            there = ", ".join(sorted(p.name for p in self.folder.glob("*"))) if self.folder.is_dir() else ""
            raise Sim2RealError(
                f"{self.folder} has no {name!r} ({usual}). Available: {there or 'nothing'}", hint=self.again
            )
        return path

    @property
    def dry(self) -> bool:
        """Whether it moved nothing."""
        return self.manifest.get("dry_run") is True

    @property
    def again(self) -> str:
        """How to make the artifact anew."""
        return f"run `sim2real {self.stage} {self.manifest.get('pipeline', 'PIPELINE')}` again"


def open_artifact(folder: Path, stage: str) -> Artifact:
    """Return a stage's folder, finished or still at work.

    Raises:
        Sim2RealError: When there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise Sim2RealError(f"there is no folder {folder}", hint=f"make one with `sim2real {stage} PIPELINE`")
    return Artifact(folder, stage, _manifest(folder))


def attempts(run_dir: Path, stage: str) -> list[Artifact]:
    """Return a stage's folders in a run (``STAGE``, ``STAGE.2``, ``STAGE.3``, ...), newest first."""
    found = []
    for folder in Path(run_dir).glob(f"{stage}*"):
        suffix = folder.name.removeprefix(stage)
        if folder.is_dir() and (suffix == "" or (suffix[0] == "." and suffix[1:].isdigit())):
            found.append((int(suffix[1:] or 1), Artifact(folder, stage, _manifest(folder))))
    found.sort(key=lambda f: (str(f[1].manifest.get("started", "")), f[0]), reverse=True)
    return [artifact for _, artifact in found]


def finished(run_dir: Path) -> dict[str, Artifact]:
    """Return stage -> its newest finished attempt, in the order of the stages; a dry run where there is no other.

    Raises:
        Sim2RealError: When there is none at all.
    """
    found = {}
    for stage in STAGES:
        done = [a for kind in _ENDED for a in attempts(run_dir, stage) if a.manifest.get("status") == kind]
        if done:
            found[stage] = done[0]
    if not found:
        raise Sim2RealError(
            f"{run_dir} has no finished stage. Looked for: {', '.join(STAGES)}",
            hint="make one with `sim2real record PIPELINE`, or name another run",
        )
    return found


def pipeline_of(run_dir: Path) -> str:
    """Return the name of the pipeline that a run belongs to.

    Raises:
        Sim2RealError: When the run has no finished stage.
    """
    manifests = [artifact.manifest for artifact in finished(run_dir).values()]
    return next((str(m["pipeline"]) for m in manifests if "pipeline" in m), "unknown")


def _manifest(folder: Path) -> Mapping[str, Any]:
    try:
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(manifest, dict):
        return {}
    return manifest if _inside(manifest.get("outputs")) else {**manifest, "outputs": {}}


def _inside(outputs: Any) -> bool:
    """Whether outputs are as a manifest names them, with paths that stay in their folder."""
    entries = outputs.values() if isinstance(outputs, dict) else [None]
    paths = [entry.get("path") if isinstance(entry, dict) else None for entry in entries]
    return all(isinstance(p, str) and not Path(p).is_absolute() and ".." not in Path(p).parts for p in paths)
