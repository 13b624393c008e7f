"""Two processes that make one training: what one makes, within float error; all of them end in words."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from environments import Bandit

from sim2real.errors import UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.ppo.trainer import train
from sim2real.training.scale.hosts import HostsConfig
from sim2real.training.scale.processes import join, leads

CONFIG = PPOConfig(
    num_envs=16, minibatches=2, rollout_steps=4, total_steps=256, hidden=(8,), evaluations=2, eval_steps=2,
    epochs=1,
)  # fmt: skip
SCRIPT = """
import json, os, sys
from dataclasses import replace
from pathlib import Path
from sim2real.training.scale.hosts import HostsConfig
from sim2real.training.scale.processes import join, leads, lost_process_errors

number, folder = int(sys.argv[1]), Path(sys.argv[3])
join(HostsConfig(coordinator=sys.argv[2], processes=2, process=number, timeout_s=20))
import jax
import numpy as np
from environments import Bandit
from test_processes import CONFIG
from sim2real.errors import Sim2RealError
from sim2real.training.ppo.trainer import train

key, own = jax.random.key(3), folder / f"{number}.safetensors"

def stop(progress):
    if progress.evaluation == 1:
        raise InterruptedError

def ended(config, report=None):
    try:
        with lost_process_errors():
            train(Bandit(), config, key, report)
    except Sim2RealError as error:
        return str(error)

try:
    train(Bandit(), CONFIG, key, stop, checkpoint=own)
except InterruptedError:
    pass
result = train(Bandit(), CONFIG, key, resume=folder / "0.safetensors")
told = {
    "leads": leads(),
    "wrote": own.is_file(),
    "found": [np.ravel(leaf).tolist() for leaf in [*jax.tree.leaves(jax.device_get(result.policies)),
                                                   *result.history.values()]],
    "differ": ended(replace(CONFIG, clip=0.1 + 0.1 * number)),
}
def leave(progress):
    if number == 1:
        (folder / "1.json").write_text(json.dumps(told))
        os._exit(3)

told["lost"] = ended(replace(CONFIG, evaluations=64, total_steps=8192), leave)
(folder / "0.json").write_text(json.dumps(told))
os._exit(0)  # the other one is gone: there is nobody to say goodbye to
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What each of two processes on this host saw."""
    folder = tmp_path_factory.mktemp("processes")
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parents[1]), os.environ.get("PYTHONPATH", "")])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    both = [
        subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(i), address, str(folder)],
            stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path},
        )
        for i in (0, 1)
    ]  # fmt: skip
    try:
        ends = [(p.communicate(timeout=240)[1], p.returncode) for p in both]
    finally:
        for process in both:
            process.kill()
    assert [code for _, code in ends] == [0, 3], ends
    return [json.loads((folder / f"{i}.json").read_text()) for i in (0, 1)]


@pytest.mark.night  # `make test` divides a training among devices: test_devices.py
def test_two_processes_learn_what_one_learns_and_go_on_where_they_were_interrupted(told):
    one = train(Bandit(), CONFIG, jax.random.key(3))
    expected = [*jax.tree.leaves(jax.device_get(one.policies)), *one.history.values()]
    for process in told:
        assert len(process["found"]) == len(expected)
        for found, own in zip(process["found"], expected, strict=True):
            np.testing.assert_allclose(found, np.ravel(own), rtol=1e-3, atol=1e-4)
    assert [(t["leads"], t["wrote"]) for t in told] == [(True, True), (False, False)]
    for process in told:
        differs = "the processes were started with different settings: clip = 0.1 in process 0 and 0.2 in process 1"
        assert differs in process["differ"]
    assert told[0]["lost"].startswith("process 0 of 2 lost another one of this training: ")
    assert "--resume newest" in told[0]["lost"]


ALONE = """
import sys
from sim2real.training.scale.hosts import HostsConfig
from sim2real.training.scale.processes import join

join(HostsConfig(coordinator=sys.argv[1], processes=1, process=0, timeout_s=20))
print("joined", flush=True)
sys.stdin.read()
"""


@pytest.mark.night
@pytest.mark.skipif(sys.platform != "linux", reason="all of 127/8 is this host's on Linux")
def test_the_coordinator_listens_where_it_was_told():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-c", ALONE, f"127.0.0.1:{port}"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "joined\n"
            socket.create_connection(("127.0.0.1", port), 5).close()
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection(("127.0.0.2", port), 5)
        finally:
            process.kill()


def test_each_process_says_who_can_join_and_where_the_coordinator_is_not_reached(monkeypatch):
    own = HostsConfig(coordinator="10.0.0.5:52700", processes=2, process=0)
    assert "any program that reaches 10.0.0.5:52700 can join or end the training: use a network that you trust" in str(
        own
    )
    assert "trust" not in str(replace(own, process=1))
    assert "the coordinator's interfaces" in str(HostsConfig(found=True))
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: [(0, 0, 0, "", ("127.0.1.1", 0))])
    assert "warning: first is 127.0.1.1 here" in str(replace(own, coordinator="first:52700"))
    assert "warning" not in str(replace(own, coordinator="localhost:52700"))
    assert "warning" not in str(replace(own, coordinator="first:52700", process=1))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"found": True, "processes": 2}, "excludes"),
        ({"coordinator": "here:1", "processes": 2}, "need all of"),
        ({"coordinator": "here", "processes": 2, "process": 0}, "must be HOST:PORT, got 'here'"),
        ({"coordinator": "here:1", "processes": 2, "process": 2}, r"must lie in \[0, 2\), got 2"),
        ({"timeout_s": 0}, r"must lie in \[5, 86400\] s"),
    ],
)
def test_processes_that_cannot_be_are_refused(settings, said):
    with pytest.raises(UsageError, match=said):
        HostsConfig(**settings)


def test_one_process_joins_nobody_and_leads():
    join(HostsConfig())
    assert leads()
    jax.devices()
    with pytest.raises(UsageError, match="the processes cannot be joined"):
        join(HostsConfig(found=True))  # without a launcher
