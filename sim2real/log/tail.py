"""Reads a log while it is being written: each call returns the steps that the writer has added since the last one."""

from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.log.file_contents import Contents, Range, readable_errors, take
from sim2real.log.reader import output_units, steps_and_outputs
from sim2real.log.records import whole_records

_ALL = Range()


class LogTail:
    """The growing end of a log.

    It only reads the file, so the process that writes the log is not aware of it.

    Args:
        path: The log, which exists and may be empty.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._position = 0
        self._contents = Contents()

    @property
    def ended(self) -> bool:
        """Whether the session has ended in order."""
        return self._contents.end is not None

    @property
    def epoch_ns(self) -> int:
        """Wall clock at the episode's time 0 [ns]."""
        return self._contents.epoch_ns

    def read(self) -> Episode | None:
        """Return the new steps, without messages; None if there is none.

        Raises:
            Sim2RealError: The file is damaged, or is no log of sim2real.
        """
        # Take the records that are whole; the next call reads the rest again.
        contents, end = self._contents, 0
        with open(self.path, "rb") as stream:
            stream.seek(self._position)
            data = stream.read()
        if self._position == 0:
            if len(data) < len(MCAP0_MAGIC):
                return None
            if not data.startswith(MCAP0_MAGIC):
                raise Sim2RealError(f"{self.path} is no MCAP file")
            end = len(MCAP0_MAGIC)
        with readable_errors(self.path):
            for record in whole_records(data, end):
                take(contents, data, record, _ALL)
                end = record.end
            self._position += end
            if not any(map(contents.messages.get, contents.with_role("step"))):
                return None
            episode = self._episode()
        # Keep the outputs whose step records are in the next chunk: the writer writes an output before its step.
        steps = {c.metadata["node"]: len(contents.messages[n]) for n, c in contents.with_role("step").items()}
        for number, channel in contents.channels.items():
            waiting = contents.messages.get(number, [])
            whole = steps.get(channel.metadata.get("node", ""), 0) if channel.metadata["role"] == "output" else None
            contents.messages[number] = [] if whole is None else waiting[whole:]
        return episode

    def _episode(self) -> Episode:
        steps, outputs, _ = steps_and_outputs(self._contents, _ALL)
        units = output_units(self._contents)
        return Episode(steps, {}, outputs, self._contents.session or {}, complete=False, units=units)
