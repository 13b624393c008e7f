"""Curves of a training, written during the training: for a live view, and for TensorBoard."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.artifacts.progress import write_progress
from sim2real.artifacts.run import OpenStage
from sim2real.errors import Sim2RealError
from sim2real.installation import with_extra
from sim2real.stages.live.viewer import live_view
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.show import Watch
from sim2real.training.ppo.result import Progress
from sim2real.training.sweep import Sweep

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter


@contextmanager
def watching(stage: OpenStage, config: TrainConfig) -> Iterator[Watch]:
    """Yield the function that receives each evaluation: it writes the curves for viewers, and for TensorBoard."""
    names = Sweep.parse(config.sweep).names(config.ppo.num_seeds)
    with ExitStack() as stack:
        stack.enter_context(live_view(config.view, stage.folder, f"train {stage.run_dir.name}", dict))
        folder = stage.output("tensorboard", "tensorboard") if config.tensorboard else None
        write_events = stack.enter_context(event_files(folder, names)) if folder else None

        def watch(progress: Progress) -> None:
            write_progress(stage.folder, progress.values)
            if write_events is not None:
                write_events(progress)

        yield watch


@contextmanager
def event_files(folder: Path, names: Sequence[str]) -> Iterator[Watch]:
    """Yield a function that writes the figures of an evaluation into event files, one for each policy.

    Args:
        names: The policies, such as ``seed 0``, in the order of the figures.

    Raises:
        Sim2RealError: tensorboardX is not installed.
    """
    make = _import_writer()
    with ExitStack() as stack:
        writers = [stack.enter_context(make(str(folder / name.replace(", ", "_").replace(" ", "_")))) for name in names]

        def write(progress: Progress) -> None:
            for name, values in progress.values.items():
                for writer, value in zip(writers, values, strict=True):
                    writer.add_scalar(name, float(value), progress.env_steps)
            for writer in writers:
                writer.flush()

        yield write


def _import_writer() -> type[SummaryWriter]:
    """Import the writer, which is an extra."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError as error:
        raise Sim2RealError(
            "files for TensorBoard need tensorboardX, which is not installed",
            hint=with_extra("tensorboard"),
        ) from error
    return SummaryWriter
