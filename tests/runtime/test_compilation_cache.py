"""The folder of compiled programs: where it is, what it holds, and that nothing about it is ever an error."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sim2real.errors import UsageError
from sim2real.runtime import compilation_cache as cache

PROGRAM = """\
import sys
from sim2real.runtime import compilation_cache
folder = compilation_cache.enable()
import jax
counts = []
jax.monitoring.register_event_listener(lambda event, **_: counts.append(event.rpartition("/")[2]))
jax.jit(lambda x: x * 3.0 + 1.0)(2.0)
print(folder, counts.count("cache_hits"), counts.count("cache_misses"))
"""


@pytest.fixture
def alone(monkeypatch, tmp_path):
    """An environment as a user has it: no cache is configured for JAX."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "SIM2REAL_CACHE", *cache._SETTINGS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.has_jax()  # remembered, before the next line
    monkeypatch.setitem(sys.modules, "jax", None)  # this process has a cache of its own
    yield tmp_path
    for name in ("JAX_COMPILATION_CACHE_DIR", *cache._SETTINGS):
        os.environ.pop(name, None)


def run(environment):
    """Compile a program in a process of its own; return folder, hits and misses."""
    named = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "SIM2REAL_"))}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM], env=named | {"JAX_PLATFORMS": "cpu"} | environment,
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    folder, hits, misses = done.stdout.split()
    return folder, int(hits), int(misses)


@pytest.mark.night
def test_a_second_process_finds_the_programs_of_the_first(tmp_path):
    environment = {"XDG_CACHE_HOME": str(tmp_path)}
    folder, hits, misses = run(environment)
    assert Path(folder).is_relative_to(tmp_path / "sim2real")
    assert (hits, misses > 0) == (0, True)
    assert run(environment) == (folder, misses, 0)


def test_the_variable_moves_the_folder_or_switches_it_off_and_the_users_jax_wins(alone, monkeypatch):
    monkeypatch.setenv("SIM2REAL_CACHE", "off")
    assert cache.enable() is None
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    monkeypatch.setenv("SIM2REAL_CACHE", str(alone / "variable"))
    assert cache.enable().is_relative_to(alone / "variable")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "mine")
    assert cache.enable() is None
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "mine"
    assert not (alone / "xdg").exists()


def test_other_processors_have_a_folder_of_their_own(alone, monkeypatch):
    here = cache.location()
    read = Path.read_text
    other = lambda path, **options: "flags : sse2\n" if str(path) == "/proc/cpuinfo" else read(path, **options)  # noqa: E731
    monkeypatch.setattr(Path, "read_text", other)
    assert cache.location() != here
    assert cache.location().parent == here.parent


def test_a_home_that_cannot_be_written_is_no_error_but_a_file_in_the_variable_is(alone, monkeypatch):
    def refused(*_args, **_options):
        raise PermissionError("read-only file system")

    with monkeypatch.context() as patch:  # the tests may run as root, who may write everywhere
        patch.setattr(cache.tempfile, "TemporaryFile", refused)
        assert cache.enable() is None
    shutil.rmtree(alone / "xdg", ignore_errors=True)
    (alone / "xdg").write_text("a file where the folder would be")
    assert cache.enable() is None
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    monkeypatch.setenv("SIM2REAL_CACHE", str(alone / "xdg"))
    with pytest.raises(UsageError, match="is no folder"):
        cache.location()


def test_the_programs_that_were_not_used_for_longest_go_first(tmp_path):
    for age, name in enumerate(("newest", "older", "oldest")):
        path = tmp_path / f"{name}-cache"
        path.write_bytes(b"x" * 100)
        os.utime(path, (1000.0 - age, 1000.0 - age))
    (tmp_path / "note.txt").write_bytes(b"x" * 1000)
    cache._cut(tmp_path, 250)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["newest-cache", "note.txt", "older-cache"]
