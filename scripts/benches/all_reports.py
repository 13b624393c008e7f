"""Every report of ``reports/``: the command that measures it, the machine that it needs, and whether it is stale."""

from __future__ import annotations

import argparse
import json
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from benches.catalogue import BENCHES, measures
from benches.provenance import ROOT, why_stale

_OTHER_RUN = "train"
"""Flag that names a run of the same machine."""


@dataclass(frozen=True)
class Plan:
    """A report that is to be measured.

    Attributes:
        arguments: Arguments of ``bench.py``; empty if no bench makes the report.
        needs: The machine that measured it.
        state: ``current``, or the reason why it is stale.
        missing: The reason why this machine cannot measure it; "" if it can.
    """

    report: Path
    arguments: tuple[str, ...]
    needs: str
    commit: str
    state: str
    missing: str


def plans(folder: Path, module_of: Callable[[str], ModuleType], data: Path | None, kinds: Sequence[str]) -> list[Plan]:
    """Return the reports of a folder in the order of their names.

    Args:
        data: Folder of the public recordings; None: reports on recordings cannot be measured.
        kinds: Kinds of the accelerators of this machine.
    """
    return [_plan(path, json.loads(path.read_text()), module_of, data, kinds) for path in sorted(folder.glob("*.json"))]


def _plan(
    path: Path,
    report: Mapping[str, Any],
    module_of: Callable[[str], ModuleType],
    data: Path | None,
    kinds: Sequence[str],
) -> Plan:
    bench, flags = report.get("bench"), dict(report.get("flags", {}))
    machine = report.get("machine", {})
    cores, devices = machine.get("cores") or 1, [d for d in machine.get("devices") or [] if d != "cpu"]
    needs = ", ".join([*devices, f"{cores} cores", *(["recordings"] if "data" in flags else [])])
    commit = (report.get("commit") or "not recorded")[:7]
    if bench not in BENCHES:
        return Plan(path, (), needs, commit, "stale: no bench makes it", "no bench makes it")
    why = why_stale(report, measures(bench, flags), ROOT)
    # Compare the machine that measured it with this one.
    missing = ""
    if lacking := [d for d in devices if d not in kinds]:
        missing = f"needs {lacking[0]}"
    elif (os.cpu_count() or 1) < cores:
        missing = f"needs {cores} cores, this machine has {os.cpu_count()}"
    elif flags.get("data") and data is None:
        missing = "needs the public recordings: --data DIR"
    elif unknown := sorted(_names(module_of(bench)) - set(flags)):
        # Their present default values may be others than those of the bench that measured it.
        missing = f"measured by a bench without {', '.join(unknown)}: name their values, and measure it by hand"
    elif flags.get(_OTHER_RUN):
        missing = f"needs a run of this machine: --{_OTHER_RUN} RUN"
    if flags.get("data") and data is not None:
        flags["data"] = data
    arguments = (bench, "--json", str(path), *_words(module_of(bench), flags))
    return Plan(path, arguments, needs, commit, f"stale: {why}" if why else "current", missing)


def _names(module: ModuleType) -> set[str]:
    """Return the names of the flags of a bench."""
    parser = argparse.ArgumentParser(add_help=False)
    module.add_flags(parser)
    return {action.dest for action in parser._actions}


def _words(module: ModuleType, flags: Mapping[str, Any]) -> list[str]:
    """Return the flags of a report as arguments of its bench; flags with their default value are omitted."""
    parser = argparse.ArgumentParser()
    module.add_flags(parser)
    words: list[str] = []
    after: list[str] = []
    for action in parser._actions:
        value = flags.get(action.dest, action.default)
        if action.dest not in flags or value == action.default or value is None:
            continue
        listed = [str(v) for v in value] if isinstance(value, list) else [str(value)]
        if not action.option_strings:
            after = ["--", *listed] if listed else []
        else:
            words += [action.option_strings[-1], *([] if action.nargs == 0 else listed)]
    return [*words, *after]


def listed(rows: Sequence[Plan]) -> list[list[str]]:
    """Return the rows of ``--list``."""
    return [[p.report.stem, p.needs, p.commit, p.state, p.missing or "can be measured here"] for p in rows]


def measure_all(rows: Sequence[Plan], measure: Callable[[Sequence[str]], int], quick: bool) -> int:
    """Measure each report that this machine can, name the others with the reason, and return an exit code."""
    worst = 0
    for p in rows:
        if p.missing:
            print(f"reports/{p.report.name} is not measured: {p.missing}")
            continue
        bench, *rest = p.arguments
        print(f"python scripts/bench.py {shlex.join([bench, '--json', f'reports/{p.report.name}', *rest[2:]])}")
        try:
            worst = max(worst, measure([bench, *(["--quick"] if quick else []), *rest]))
        except Exception as error:  # what fails must not lose the reports behind it
            print(f"reports/{p.report.name} is not measured: {type(error).__name__}: {error}")
            worst = max(worst, 1)
    return worst
