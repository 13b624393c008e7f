"""Curves of a training for TensorBoard, written during the training."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.artifacts.run.run_folder import OpenStage
from sim2real.errors import Sim2RealError
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.show import Watch
from sim2real.train.ppo.result import Progress
from sim2real.train.sweep import Sweep

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter


def watching(stage: OpenStage, config: TrainConfig) -> AbstractContextManager[Watch | None]:
    """Yield the function that receives each evaluation: the writer of TensorBoard's files, or None."""
    if not config.tensorboard:
        return nullcontext()
    names = Sweep.parse(config.sweep).names(config.ppo.num_seeds)
    return event_files(stage.output("tensorboard", "tensorboard"), names)


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
            hint="pip install 'sim2real[tensorboard]'",
        ) from error
    return SummaryWriter
