"""Which runs are compared; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from sim2real.errors import UsageError


@dataclass(frozen=True)
class CompareConfig:
    """Compare runs: parameters with intervals, errors and success, and which parameters differ beyond chance."""

    runs_to_compare: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN...")] = ()
    """Run folders, their names, stage folders in them, or pipelines, whose newest run is taken; at least two."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Page to write; default: compare.html in the working directory."""
    json: bool = False
    """Print JSON instead of tables."""

    @property
    def targets(self) -> tuple[str, ...]:
        """The runs, at least two."""
        if len(self.runs_to_compare) < 2:
            raise UsageError(
                f"compare needs at least two runs, got {len(self.runs_to_compare)}",
                hint="sim2real compare runs/NAME/FIRST runs/NAME/SECOND",
            )
        return self.runs_to_compare
