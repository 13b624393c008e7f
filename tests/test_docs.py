"""The pages: their Python runs, their command lines have flags that exist, their links and names lead somewhere."""

import ast
import contextlib
import functools
import importlib
import importlib.util
import io
import itertools
import re
import shlex
import textwrap
from pathlib import Path

import jax
import pytest

from sim2real import cli
from sim2real.cli import COMMANDS

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NIGHT = pytest.mark.night
OPTIONAL = {"stable_baselines3"}
"""Packages that no extra brings: their blocks are left out where they are not installed."""
FOREIGN = {"Buffer", "MovableCamera", "NameScope", "Twist", "VecNormalize"}
"""Classes of others that pages name and our code does not."""
GROUPS = {"sim2real.pipelines", "sim2real.devices", "sim2real.worlds"}
"""Groups of entry points, which are named like modules."""

# -- Python


def python_of(page: str) -> list[str]:
    """Return the blocks of Python of a page, or of a module's docstring, where they are indented behind ``::``."""
    if not page.endswith(".md"):
        blocks = re.findall(r"::\n\n((?:    .*\n|\n)+)", importlib.import_module(page).__doc__ or "")
        return [textwrap.dedent(block) for block in blocks]
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)


MARKS = {
    "README.md": [NIGHT],
    "docs/guides/compose.md": [NIGHT],
    "docs/guides/identify.md": [NIGHT],
    "docs/guides/interop.md": [NIGHT],
    "docs/guides/notebook.md": [NIGHT],
    "docs/reference/runs.md": [NIGHT],
    "docs/tutorial.md": [NIGHT],
    "sim2real.identification": [NIGHT],
    "sim2real.runtime": [NIGHT],
}
TINY_FIT = '{"refine_steps": 3, "folds": 0, "free_run_s": 0.0}'
TINY_PPO = '{"episode_s": 2.0, "timelines": 4, "ppo": {"total_steps": 512, "num_envs": 16, "minibatches": 2}}'
SMALLER = {
    "README.md": {"(pendulum, model)": f"(pendulum, model, {TINY_PPO})"},
    "docs/guides/interop.md": {"1_000_000": "64", "num_envs=64": "num_envs=2", "num_envs=128": "num_envs=2"},
    "docs/reference/runs.md": {
        ", recording)": f", recording, {TINY_FIT})",
        ", identification)": f", identification, {TINY_PPO})",
    },
    "sim2real.identification": {"FitConfig()": "FitConfig(population=8, generations=2, refine_steps=3)"},
}
"""Page -> what it computes -> what is computed here instead."""
FILES = {"docs/tutorial.md": "pipelines/head/robot.py"}
"""Pages whose first block is a file."""
TRUE = {
    "README.md": [
        "model.verdict.status == 'accepted'",
        "20.96 < model.intervals['gain'][0] < 21.10 < model.intervals['gain'][1] < 21.19",
        "0.0442 < model.intervals['round_trip_delay'][0] < 0.0445 < model.intervals['round_trip_delay'][1] < 0.0449",
        "(folder / 'trained' / 'bundle' / 'policy.onnx').is_file()",
    ],
    "docs/graph.md": [
        "abs(nodes['agent'].phase - 0.003) < 1e-9 and abs(nodes['actuator'].phase - 0.007) < 1e-9",
        "(Actuator.sent[0], Actuator.sent[-1]) == ('torque on', 'torque off') and len(Actuator.sent) > 5",
        "heights[0] < -0.5 and heights.max() > 0.9",  # pushing in the direction of motion swings it up
    ],
    "docs/guides/compose.md": ["task.arm.joints[0].full_identifier == 'arm/shoulder'"],
    "docs/guides/interop.md": ["robot.step_limit == 249"],
    "docs/guides/robot_computer.md": [
        "abs(features(Measurement(3.141592653589793)) - [-1.0, 0.0]).max() < 1e-6",
        "abs(reward(Measurement(3.141592653589793)) + 1.0) < 1e-6",
    ],
    "docs/tutorial.md": ["test_the_head_is_a_robot(folder) is None"],
    "sim2real.identification": ["judgement.status and (spread.low <= spread.high).all()"],
    "sim2real.runtime": ["abs(float(simulated) - float(of_first_episode)) < 1e-6 and of_all_episodes.shape == (4,)"],
}
"""Page -> what its text says about the names that its blocks leave behind."""


def optional(block: str) -> set[str]:
    """Return the optional packages that a block imports and that are not installed."""
    imported = (n.module or "" for n in ast.walk(ast.parse(block)) if isinstance(n, ast.ImportFrom))
    packages = {name.split(".")[0] for name in imported}
    return {name for name in packages & OPTIONAL if not importlib.util.find_spec(name)}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=MARKS.get(page, []))
        for page in [*(p.relative_to(ROOT).as_posix() for p in PAGES), "sim2real.identification", "sim2real.runtime"]
        if python_of(page)
    ],
)
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch, request):
    blocks = [(i, block) for i, block in enumerate(python_of(page), start=1) if not optional(block)]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jax, "device_put_replicated", None, raising=False)  # interop.md defines it, for all of JAX
    (tmp_path / "datasets").symlink_to(ROOT / "datasets")
    if file := FILES.get(page):
        (tmp_path / file).parent.mkdir(parents=True)
        (tmp_path / file).write_text(blocks.pop(0)[1])
    if page == "docs/tutorial.md":
        xml = (ROOT / page).read_text().split("```xml\n")[1].split("```")[0]
        (tmp_path / "pipelines" / "head" / "head.xml").write_text(xml)
    names = {"__name__": "page", "folder": tmp_path}
    for number, block in blocks:
        for large, small in SMALLER.get(page, {}).items():
            block = block.replace(large, small)
        if "runs/pendulum/TIME" in block:
            block = block.replace("runs/pendulum/TIME", str(request.getfixturevalue("finished_run_dir")))
        exec(compile(block, f"{page}, block {number}", "exec"), names)
    assert [claim for claim in TRUE.get(page, ()) if not eval(claim, names)] == []


def test_the_pictures_of_the_timing_rules_show_what_the_schedule_computes():
    """Compared by their data, which each picture holds."""
    spec = importlib.util.spec_from_file_location("draw_timing", ROOT / "docs" / "draw_timing.py")
    drawing = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(drawing)
    cases = dict(drawing.cases())
    shown = {path.stem: drawing.described(path) for path in (ROOT / "docs" / "timing").glob("*.svg")}
    assert shown == cases, "run `python docs/draw_timing.py`"
    assert {name[0] for name in cases} == set("1234567"), "a picture for each rule"


# -- command lines

LINE = re.compile(r"^(?: *\w*\$ |    )(?:\w+=\S+ )?(sim2real [a-z]+(?: .*)?)$|`(sim2real [a-z][^`]*)`", re.MULTILINE)


@functools.cache
def help_of(*words: str) -> str:
    """Return the help of a command with these arguments before ``--help``; empty if they are no command."""
    text = ""
    for flag in ("--help", "--help-all"):
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()):
            text += out.getvalue() if cli.main([*words, flag]) == 0 else ""
    return text


def unknown_flags(line: str) -> list[str]:
    """Return the flags in a command line that the help of its command does not list."""
    words = shlex.split(re.split(r"&&|;|\|", line)[0], comments=True)
    flags = [word.split("=")[0] for word in words if word.startswith("--") and word not in ("--help", "--help-all")]
    command, *names = itertools.takewhile(lambda word: not word.startswith("-"), words[1:])
    text = help_of(command) + help_of(command, *names[:1]) if flags else ""
    return [flag for flag in flags if not re.search(rf"{flag}(?![\w-])", text)]


def test_command_lines_of_pages_have_flags_that_exist():
    found = [(page.name, m) for page in PAGES for m in LINE.findall(page.read_text().replace("\\\n", " "))]
    lines = {(page, " ".join((quoted or inline).split())) for page, (quoted, inline) in found}
    wrong = {key: flags for key in lines if key[1].split()[1] in COMMANDS if (flags := unknown_flags(key[1]))}
    assert wrong == {}
    assert {key for key in lines if key[1].split()[1] not in COMMANDS} == set(), "commands that do not exist"
    assert unknown_flags("sim2real train pendulum --seed 1 --sead 2  # --none") == ["--sead"]


def commands_of(page: str) -> set[str]:
    """Return the commands in tables with a column ``command``, and in backticks with a flag, without ``sim2real``."""
    found, column = set(re.findall(r"`([a-z]+ [^`]*--[^`]*)`", page)), None
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.split("|")] if line.startswith("|") else []
        if not cells or "command" in cells:
            column = cells.index("command") if cells else None
        elif column is not None:
            found |= {quoted.removeprefix("sim2real ") for quoted in re.findall(r"`([^`]+)`", cells[column])}
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_bare_commands_of_a_page_exist(page):
    commands = {line: line.split()[0] for line in commands_of(without_code(page.read_text()))}
    in_tables = {line for line in commands if "--" not in line}
    assert {line for line in in_tables if commands[line] not in COMMANDS} == set()
    mine = [line for line, first in commands.items() if first in COMMANDS]
    assert {line: flags for line in mine if (flags := unknown_flags(f"sim2real {line}"))} == {}


@functools.cache
def all_flags() -> str:
    """Return the help of all commands, of two robots, and the code of the benches; ``--no-x`` is the flag ``--x``."""
    of_robots = [help_of(stage, robot) for stage in ("record", "train", "deploy") for robot in ("pendulum", "go2")]
    benches = [path.read_text() for path in (ROOT / "scripts").rglob("*.py")]
    return "\n".join([*map(help_of, COMMANDS), *of_robots, *benches])


def test_flags_in_backticks_exist():
    quoted = {q: page.name for page in PAGES for q in re.findall(r"`(--[^`]*)`", without_code(page.read_text()))}
    named = {(page, flag) for q, page in quoted.items() for flag in re.findall(r"--[a-z][\w.-]*", q)}
    wrong = [
        (page, flag)
        for page, flag in sorted(named - {("robot_computer.md", "--no-deps")})  # pip's
        if not re.search(rf"{flag.replace('--no-', '--').replace('.no-', '.')}(?![\w-])", all_flags())
    ]
    assert wrong == []
    assert not re.search("--no-such-flag", all_flags())


def test_benches_of_pages_exist():
    benches = set(re.findall(r'^    "([a-z][\w-]*)": ', (ROOT / "scripts" / "bench.py").read_text(), re.MULTILINE))
    used = {name for page in PAGES for name in re.findall(r"scripts/bench\.py ([a-z][\w-]*)", page.read_text())}
    assert "league" in used & benches
    assert used - benches == set()


# -- links and names


def without_code(text: str) -> str:
    """Return a page without its blocks of code."""
    return re.sub(r"^(`{3,}).*?^\1$", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as MyST and GitHub make them."""
    headings = re.findall(r"^#+ (.+)$", without_code(page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_and_paths_of_a_page_lead_to_files_and_headings(page):
    text = without_code(page.read_text())
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        name, _, anchor = target.partition("#")
        path = page.parent / name if name else page
        if not target.startswith("https://"):
            assert path.exists(), target
            assert not anchor or path.suffix != ".md" or anchor in anchors(path), target
    if not page.stem.startswith("tutorial"):  # they name the reader's files
        paths = re.findall(r"`((?:sim2real|pipelines|scripts|tests|datasets|reports)/[\w/.*-]+\.\w+)`", text)
        assert [path for path in paths if not list(ROOT.glob(path))] == []


def test_names_of_modules_classes_and_functions_on_pages_exist():
    names = {m[0]: p.name for p in PAGES for m in re.finditer(r"\bsim2real(?:\.[A-Za-z_]\w*)+", p.read_text())}
    assert [(page, name) for name, page in names.items() if name not in GROUPS and not exists(name)] == []
    assert not exists("sim2real.graph.no_such_module")


@functools.cache
def words_of_the_code() -> set[str]:
    """Return all words of our code, of the packages in tests, and of the files beside robots."""
    folders = ("sim2real", "pipelines", "scripts", "tests/plugin", "tests/hardware")
    files = [
        p for folder in folders for p in (ROOT / folder).rglob("*") if p.suffix in (".py", ".toml", ".xml", ".jinja")
    ]
    return set(re.findall(r"\w+", "\n".join(p.read_text() for p in files)))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_classes_in_backticks_exist(page):
    """Their attributes too; a page may name classes of its own code, a tutorial those of the reader."""
    text = page.read_text()
    own = set(re.findall(r"\w+", "\n".join(python_of(page.relative_to(ROOT).as_posix()))))
    named = re.findall(r"`([A-Z]\w*[a-z]\w*(?:\.\w+)*)(?:\([^`]*\))?`", without_code(text))
    assert [name for name in named if not set(name.split(".")) <= words_of_the_code() | own | FOREIGN] == []


def exists(name: str) -> bool:
    """Return whether a dotted name is a module, or a name in one."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:length])
        if path.with_suffix(".py").is_file() or (path / "__init__.py").is_file():
            value = importlib.import_module(".".join(parts[:length]))
            return functools.reduce(lambda at, part: getattr(at, part, None), parts[length:], value) is not None
    return False
