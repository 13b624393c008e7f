"""``sim2real log recover``: copies the readable part of a damaged log."""

from sim2real.commands.config import RecoverConfig
from sim2real.log.recovery import recover
from sim2real.stages.terminal.console import note, table, wrote


def run(config: RecoverConfig) -> None:
    """Write the new file; print the numbers of its messages and the unreadable parts.

    Raises:
        Sim2RealError: When the file is missing or not an MCAP file, or the new file exists or cannot be written.
    """
    source = config.source
    target = config.out or source.with_name(f"{source.stem}.recovered.mcap")
    recovery = recover(source, target)
    for lost in recovery.skipped:
        note(f"unreadable: {lost}")
    if recovery.cut:
        note("the file ends before its data does")
    print(table(sorted(recovery.messages.items()), ["topic", "messages"]))
    wrote(target)
