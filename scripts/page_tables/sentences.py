"""Sentences and tables of measured figures for the pages of docs/, each from the reports that have the figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

_JOINT = "/worst_joint"


def values(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rows of a report: name -> value."""
    return {row["name"]: row["value"] for row in report["rows"]}


def on_a_gpu(pendulum: Mapping[str, Any]) -> str:
    """Return how long a training takes on an accelerator."""
    v = values(pendulum)
    base = next(name for name in v if name.endswith("compile_s")).rpartition("/")[0]
    return (
        f"{pendulum['flags']['seeds']} seeds of the pendulum, trained side by side on one "
        f"{pendulum['machine']['devices'][0]}, are all above 85 % after\n"
        f"{v[f'{base}/time_to_0.85_all_s']:.1f} s, {v[f'{base}/compile_s']:.1f} s of them compilation.\n"
    )


def walk(report: Mapping[str, Any]) -> str:
    """Return a table of the falls and errors of a walking policy, a row for each set of twins."""
    v = values(report)
    about = {row["name"]: row["yardstick"] for row in report["rows"]}
    lines = ["| twins | falls | error | error |", "| --- | ---: | ---: | ---: |"]
    for case in [name.split("/")[1] for name in v if name.endswith("/falls")]:
        at = f"walk/{case}"
        delay = f", delay {case.split('_')[1]} ms" if case.endswith("_ms") else ""
        falls, of = v[f"{at}/falls"], about[f"{at}/falls"].partition(" ")[0]
        errors = f"{v[f'{at}/error_m_s']:.3f} m/s | {v[f'{at}/error_rad_s']:.3f} rad/s"
        lines.append(f"| {about[f'{at}/falls']}{delay} | {falls:g} of {of} | {errors} |")
    return "\n".join(lines) + "\n"


_OF_TRAINING = {
    "graph_over_bare": "the graph over as many bare `mjx.step`",
    "learnt_steps_per_s": "learnt steps a second",
    "command_s": "from the command to the policy's bundle",
    "compile_s": "of it: trace and compile",
    "calm/falls": "falls of its twins",
    "calm/error_m_s": "error of the velocity",
    "calm/error_rad_s": "error of the yaw rate",
    "pushed/falls": "falls with pushes",
    "kernels_s": "once on a machine: Warp's kernels",
}


def walk_train(report: Mapping[str, Any]) -> str:
    """Return a table of a walking policy's training on one GPU beside its goals."""
    rows = {row["name"].removeprefix("walk_train/").split("/", 1)[-1]: row for row in report["rows"]}
    lines = ["| | measured | goal |", "| --- | ---: | ---: |"]
    for name, label in _OF_TRAINING.items():
        lines.append(f"| {label} | {rows[name]['value']:,} {rows[name]['unit']} | {rows[name]['goal']} |")
    return "\n".join(lines).replace(" 1 |", " |") + "\n"


def walk_rival(report: Mapping[str, Any]) -> str:
    """Return a sentence about MuJoCo Playground's training beside ours."""
    v, parts = ({n.removeprefix("walk_rival/"): x for n, x in values(report).items()}, report["playground"])
    last = parts[-1]
    flags = report["flags"]
    return (
        f"MuJoCo Playground trains its Go1 with brax's PPO, in the same run and with its own settings, at "
        f"{v['playground/learnt_steps_per_s'] / 1e6:.2f} M learnt steps a second; ours learnt "
        f"{v['ours/learnt_steps_per_s'] / 1e6:.2f} M. After {last['steps'] / 1e6:.0f} M steps and "
        f"{last['wall_s']:.0f} s its error was {last['error_m_s']:.3f} m/s, and {last['fell']} of {last['of']} "
        f"copies fell in {flags['seconds']:g} s. After {flags['steps'] / 1e6:.0f} M steps and "
        f"{v['ours/command_s']:.0f} s ours was {v['ours/calm/error_m_s']:.3f} m/s, and {v['ours/calm/falls']} of "
        f"{flags['twins']} twins fell. Each error is of the policy's own simulation: the robots, commands and "
        "noise differ, and Playground's robot has no delay.\n"
    )


def legs_identify(report: Mapping[str, Any]) -> str:
    """Return a table of the errors of identified Go2s, a row for each kind of parameter."""
    v = values(report)
    about = {row["name"]: row["yardstick"] for row in report["rows"]}
    counted = lambda name: about[f"legs_identify/{name}"].split(" ")  # noqa: E731
    lines = ["| | within 10 % | worst |", "| --- | ---: | ---: |"]
    for kind in ("damping", "friction", "armature", "strength"):
        near, _, of, *_ = counted(f"{kind}/close")
        label = "strength of a motor" if kind == "strength" else f"{kind} of a group"
        lines.append(f"| {label} | {near} of {of} | {v[f'legs_identify/{kind}/worst']:.2g} % |")
    near, _, of, *_ = counted("delay/close")
    lines.append(f"| sum of the delays, within 1 ms | {near} of {of} | {v['legs_identify/delay/worst']:.2f} ms |")
    near, _, of, *_ = counted("load/close")
    # A fit that did not converge estimates no load.
    loads = [float(twin["load_off_kg"]) for twin in report["twins"] if float(twin["load_off_kg"]) < float("inf")]
    worst = f"{max(loads):.2f} kg, the worst of {len(loads)}"
    lines.append(f"| load in the base, within 0.3 kg | {near} of {of} | {worst} |")
    (yes, _, twins, *_), whole = counted("accepted"), about["legs_identify/all_close"]
    interval = whole.rpartition("; ")[2].replace("95 % interval ", "")
    held, _, of, *_ = counted("intervals")
    others = [f" (twin {t['seed']}: {t['verdict']})" for t in report["twins"] if t["verdict"] != "accepted"]
    text = (
        f"{yes} of {twins} identifications are accepted{''.join(others)}; in "
        f"{whole.split(' ')[0]} all parameters are within 10 % (95 % interval of that share: {interval}).\n"
        f"The 95 % intervals hold the truth in {held} of {of} cases. "
        f"On {report['machine']['cores']} cores an identification takes\n{v['legs_identify/wall_s']:.0f} s at most, "
        f"{v['legs_identify/cpu_s']:.0f} s of a processor.\n"
    )
    return "\n".join([*lines, "", text])


def carried(report: Mapping[str, Any]) -> str:
    """Return the result for an arm that carries its own weight."""
    v = {name.removeprefix("carried/"): value for name, value in values(report).items()}
    truth = {row["name"]: row["yardstick"] for row in report["rows"]}
    model = truth["carried/stiffness_error"].rpartition(" ")[2]
    return (
        f"`auto` chooses the terms `{v['terms']}`. The controller carries {v['gravcomp']:.2f} of the weight (true: "
        f"{truth['carried/gravcomp']}).\nStiffnesses are {v['stiffness_error']:.1f} % off, the maker's {model}. "
        f"Verdict: {v['verdict']}, after {v['seconds'] / 60:.0f} min on "
        f"{report['machine']['cores']} cores.\n"
    )


def twin(report: Mapping[str, Any]) -> str:
    """Return the time of `new --like so101`, from an empty environment to an accepted twin."""
    v = values(report)
    return (
        f"From an empty environment to an accepted twin of the emulated arm, on {report['machine']['cores']} cores: "
        f"{v['twin/wall']:.0f} s,\nof which the installation takes {v['twin/install']:.0f} s "
        f"(`python scripts/bench.py twin`). The arm is moved by a program, as the command asks.\n"
    )


def light(report: Mapping[str, Any]) -> str:
    """Return the size of sim2real-robot, and the processor time of record there."""
    v = values(report)
    return (
        f"Its packages take {v['light/packages']:.0f} MB. `record` uses {v['light/pendulum/addressed']:.2f} s of "
        f"processor time until it addresses the pendulum,\nand {v['light/so101/addressed']:.2f} s for the SO-101 "
        f"(`python scripts/bench.py light`).\n"
    )


def faults(report: Mapping[str, Any]) -> str:
    """Return the number of runs that were safe, and how late the latest one was."""
    v, kinds = values(report), report["flags"]["faults"]
    runs = len(kinds) * report["flags"]["runs"]
    latest_s = max(v[f"faults/{kind}/safe_s"][1] for kind in kinds)
    safe, readable, right = (
        sum(v[f"faults/{kind}/{what}"] for kind in kinds) for what in ("safe", "log_readable", "code_and_reason")
    )
    return (
        f"Of {runs} runs, {report['flags']['jobs']} at a time, {safe} were safe, the latest after {latest_s:.3f} s. "
        f"{readable} left a readable log,\nand {right} ended with the correct exit code and reason.\n"
    )


def on_warp(report: Mapping[str, Any]) -> str:
    """Return the table of tasks on MuJoCo Warp against bare steps."""
    v = {name.removeprefix("compose/gpu/warp/"): value for name, value in values(report).items()}
    copies = dict.fromkeys(int(name.partition("/")[0]) for name in v)
    lines = [
        "| copies | physics steps per second, `mjx.step` alone | time of the task with late observables | time of the "
        "task in a graph with delays |",
        "|---:|---:|---:|---:|",
        *(
            f"| {n:,} | {v[f'{n}/bare_steps_per_s'] / 1e6:.1f} million | {v[f'{n}/env_over_bare']:.3f} times as long | "
            f"{v[f'{n}/graph_over_bare']:.3f} times |"
            for n in copies
        ),
    ]
    compiled = [v[f"{n}/{kind}_compile_s"] for n in copies for kind in ("env", "graph")]
    kernels_s = max(v[f"{n}/first_reset_s"] for n in copies)
    return "\n".join(lines) + (
        f"\n\nA program takes {min(compiled):.0f} to {max(compiled):.0f} s to compile; building Warp's kernels takes "
        f"{kernels_s:.0f} s more, once for a machine.\n"
    )


def compiled_graph(*reports: Mapping[str, Any]) -> str:
    """Return how long the compiled pendulum takes against a simulation written by hand, for each accelerator."""
    texts = []
    for report in reports:
        v = values(report)
        hand, unrolled, divided = (
            _between(
                value for name, value in v.items() if name.endswith(f"/{what}") and ("30_over_100_hz" in name) == uneven
            )
            for what, uneven in (("over_hand", False), ("over_hand_unrolled", False), ("over_hand", True))
        )
        texts.append(
            f"The compiled pendulum takes {hand} times as long on an {report['flags']['name'].upper()} as a simulation "
            f"written by hand,\n{unrolled} times as long if that simulation has an unrolled loop too, and {divided} "
            "times as long\nif rates do not divide.\n"
        )
    return "\n".join(texts)


def _between(numbers: Iterable[float]) -> str:
    listed = sorted(numbers)
    return f"{listed[0]:.2f} to {listed[-1]:.2f}"


def on_the_wall_clock(report: Mapping[str, Any]) -> str:
    """Return the success of worn robots that were deployed as emulated servos."""
    v, flags = values(report), report["flags"]
    runs = flags["robots"] * flags["trials"]

    def of(way: str) -> str:
        upright, still = (round(runs * v[f"randomise/wall/{way}/{what}"]) for what in ("success", "still"))
        return f"{upright} of {runs} were upright, {still} of these slower than 0.5 rad/s"

    return (
        f"{flags['robots']} worn robots were also deployed on the wall clock, as emulated servos, "
        f"{flags['trials']} deployments each. After training on the\nestimate alone {of('point')};\nafter training on "
        f"posterior, misfit, timing and noise {of('all')}.\n"
    )


def worst_joint(league: Mapping[str, Any]) -> str:
    """Return the range over all entrants of the worst joint of the SO-101."""
    joints = [
        x for name, x in values(league).items() if name.startswith("league/so101/") and name.endswith(_JOINT) and x
    ]
    if not joints:
        return ""
    return f"The worst joint of the SO-101 is off by {min(joints):.0f} to {max(joints):.0f} mrad with every tool.\n"


def drift(*reports: Mapping[str, Any]) -> str:
    """Return the table of robots for which the verdict was to identify again, by change."""
    kinds = {"none": "false_alarms", **dict.fromkeys(("friction", "payload", "delay"), "detected")}
    heads = "| robots | unchanged | friction doubled | payload +30 % | 15 ms more |\n|---|---|---|---|---|\n"
    return heads + _by_robot(reports, kinds)


def restored(*reports: Mapping[str, Any]) -> str:
    """Return the table of successful deployments after one iteration of the loop, by change."""
    kinds: dict[str, str] = dict.fromkeys(("friction", "payload", "delay"), "restored")
    return "| robots | friction doubled | payload +30 % | 15 ms more |\n|---|---|---|---|\n" + _by_robot(reports, kinds)


def _by_robot(reports: Iterable[Mapping[str, Any]], kinds: Mapping[str, str]) -> str:
    """Return a line for each robot: how often it happened, and how often it could, over its reports."""
    counts: dict[tuple[str, str], tuple[int, int]] = {}
    for report in reports:
        for row in report["rows"]:
            robot, change, what = (*row["name"].split("/")[1:], "", "")[:3]
            of = int(row["unit"].removeprefix("of ")) if row["unit"].startswith("of ") else 0
            if kinds.get(change) == what and row["name"].count("/") == 3 and of:
                happened, could = counts.get((robot, change), (0, 0))
                counts[robot, change] = happened + round(of * row["value"]), could + of
    names = {"pendulum": "pendulums", "arm": "arms", "so101": "SO-101s"}
    lines = [
        [label, *(_of(*counts.get((robot, change), (0, 0))) for change in kinds)] for robot, label in names.items()
    ]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def _of(happened: int, could: int) -> str:
    return f"{happened} of {could}" if could else "-"


def on_more_devices(report: Mapping[str, Any]) -> str:
    """Return the speed of a training on all devices of a host against one."""
    v = {name.rpartition("train/")[2]: value for name, value in values(report).items()}
    count = next(name.removesuffix("_over_1") for name in v if name.endswith("_over_1"))
    cards = f"{count} {report['flags']['name'].upper()}s"
    return (
        f"{cards} of one host make {v[f'{count}_over_1']:.2f} times the steps of one, "
        f"{v[f'{count}_devices/env_steps_per_s'] / 1e6:.1f} million policy steps per second\nof a single policy.\n"
    )
