"""Configuration, files and versions of a stage, at the end of its section."""

from sim2real.artifacts.run.run_folder import StageFolder
from sim2real.view.blocks import Block, FoldBlock, pairs_table


def about(artifact: StageFolder) -> list[Block]:
    """Return configuration, files and versions of a stage as a folded block."""
    m = artifact.manifest
    when = {k: m[k] for k in ("started", "duration_s", "command", "git") if m.get(k) is not None}
    files = {n: e.get("sha256", "") for n, e in m.get("outputs", {}).items()}
    tables = {
        "Summary": m.get("summary"),
        "Configuration": m.get("config"),
        "Run": when,
        "Inputs": m.get("inputs"),
        "Outputs, by SHA-256": files,
        "Versions": m.get("versions"),
    }
    blocks = [pairs_table(caption, tree) for caption, tree in tables.items() if tree]
    return [FoldBlock("Configuration, files and versions", blocks)] if blocks else []
