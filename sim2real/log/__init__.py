"""Logs: one MCAP file per session, written while the robot runs and readable after a crash."""

from sim2real.log.importing.importer import import_file as import_file
from sim2real.log.importing.mapping import ImportMapping as ImportMapping
from sim2real.log.importing.mapping import load_mapping as load_mapping
from sim2real.log.reader import LogTail as LogTail
from sim2real.log.reader import TruncatedLogWarning as TruncatedLogWarning
from sim2real.log.reader import read_log as read_log
from sim2real.log.reader import read_session as read_session
from sim2real.log.reader import summary as summary
from sim2real.log.writer import McapRecorder as McapRecorder
