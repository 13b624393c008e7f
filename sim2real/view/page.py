"""Pages for a browser: one self-contained HTML file, without scripts and without a network."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from sim2real.artifacts.comparison import Comparison
from sim2real.artifacts.run import STAGES, StageFolder, attempts, finished_stages, stage_status
from sim2real.view.blocks import Banner, NoteBlock, PageSection, TableBlock
from sim2real.view.sections import SECTIONS, iterations_sections

PAGE = "report.html"
_MOST_REASONS = 3
"""Number of sentences in a verdict's box: reason, expected error, next command. Others are collapsed, so that the first
screen of a telephone has the figure.
"""


def report(run_dir: Path, out: Path | None = None) -> Path:
    """Write the report of a run, with a section for each finished stage.

    Args:
        out: The page to write; None: ``report.html`` in the run's folder.

    Returns:
        Path of the page.

    Raises:
        Sim2RealError: No stage is finished, or a file of a stage is missing or malformed.
    """
    run_dir = Path(run_dir)
    artifacts = finished_stages(run_dir)
    sections = [SECTIONS[stage](artifact) for stage, artifact in artifacts.items()] + iterations_sections(run_dir)
    manifests = [artifact.manifest for artifact in artifacts.values()]
    started = min(m.started for m in manifests)
    return write_page(
        out or run_dir / PAGE,
        manifests[0].pipeline,
        sections,
        run=run_dir.resolve().name,
        started=started.replace("T", " ")[:19] + (" UTC" if started.endswith("+00:00") else ""),
        version=next((m.versions.get("sim2real") or "" for m in manifests), ""),
        absent={stage: _tried(run_dir, stage) for stage in STAGES if stage not in artifacts},
        notes=_about_others(run_dir, artifacts),
    )


def comparison_page(comparison: Comparison, path: Path) -> Path:
    """Write the page of a comparison and return its path."""
    different = ", ".join(comparison.different)
    title = f"intervals that do not overlap: {different}" if different else "the intervals of all parameters overlap"
    blocks = [
        TableBlock.of("Verdicts, errors and scores", comparison.figures()),
        TableBlock.of("Parameters: estimate and half-width of the 95 % interval", comparison.rows()),
    ]
    lead = f"{len(comparison.runs)} runs: {', '.join(run.name for run in comparison.runs)}."
    banner = Banner("doubt" if different else "good", title)
    return write_page(path, "comparison", [PageSection("compare", "Comparison", lead, (), blocks, banner)])


def write_page(
    path: Path,
    pipeline: str,
    sections: Sequence[PageSection],
    *,
    run: str = "",
    started: str = "",
    version: str = "",
    absent: Mapping[str, str] | None = None,
    notes: Sequence[NoteBlock] = (),
) -> Path:
    """Render sections as a page, and write it atomically, so that no browser reads an incomplete page.

    Args:
        absent: Stage without a section -> its status, for the head of a page with several sections.
    """
    environment = Environment(
        loader=PackageLoader("sim2real.view"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template("page.html").render(
        pipeline=pipeline,
        run=run,
        started=started,
        version=version,
        sections=sections,
        absent=absent or {},
        most_reasons=_MOST_REASONS,
        notes=notes,
    )
    # Write a draft and rename it, as a rename is atomic.
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.tmp")
    draft.write_text(text, encoding="utf-8", errors="replace")  # such as half a surrogate pair in the name of a file
    os.replace(draft, path)
    return path


def _tried(run_dir: Path, stage: str) -> str:
    """Return the status of an unfinished stage: that of its newest attempt, or ``not yet``."""
    tried = attempts(run_dir, stage)
    return tried[0].manifest.status if tried else "not yet"


def _about_others(run_dir: Path, artifacts: dict[str, StageFolder]) -> list[NoteBlock]:
    """Return notes on stages that are stale, or whose newest attempt did not finish."""
    notes = []
    # Mention newer attempts that have no section.
    for stage in STAGES:
        tried = attempts(run_dir, stage)
        if tried and (stage not in artifacts or tried[0].folder != artifacts[stage].folder):
            status = tried[0].manifest.status
            status = "a dry run" if status == "dry run" else status
            error = re.sub(r"^\w+: ", "", tried[0].manifest.error)  # the exception's name is for the log
            shown = (
                f"this page shows {artifacts[stage].folder.name}"
                if stage in artifacts
                else "the page has no section for it"
            )
            notes.append(
                NoteBlock(f"The newest attempt at {stage} is {status}{f' ({error})' if error else ''}: {shown}.")
            )
    stale = {stage: s.stale for stage, s in stage_status(run_dir).items() if s.stale}
    notes += [NoteBlock(f"Out of date: {why}. `sim2real run --resume` repeats the stage.") for why in stale.values()]
    return notes
