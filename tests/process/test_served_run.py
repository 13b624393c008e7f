"""``report --rerun web`` serves a run to browsers; ``--follow`` joins one that goes on."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("rerun")


@pytest.mark.process
@pytest.mark.night
@pytest.mark.parametrize("follow", [True, False])
def test_a_run_is_served_to_browsers_until_ctrl_c(run_copy, follow):
    flags = ["--rerun", "web", *(["--follow"] if follow else [])]
    command = [sys.executable, "-m", "sim2real.cli", "report", str(run_copy), *flags]
    environment = {**os.environ, "RERUN_ANALYTICS_ENABLED": "0"}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        said = ""
        while "Ctrl-C" not in said:
            line = process.stderr.readline()
            assert line, said
            said += line
        address = re.search(r"open http://[^:]+:(\d+)/\?url=rerun%2Bhttp://[^:]+:(\d+)/proxy", said)
        assert address, said
        listening = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        ports = {f"{int(port):04X}" for port in address.groups()}
        places = [fields[1].split(":") for fields in listening if fields[3] == "0A"]
        hosts = {host for host, port in places if port in ports}
        assert hosts == {"0100007F"}, "the page and its data are served on 127.0.0.1 alone"
        with contextlib.closing(urllib.request.urlopen(f"http://127.0.0.1:{address[1]}", timeout=10)) as page:
            assert "rerun" in page.read().decode().lower()
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        process.stderr.read()
        assert process.wait(20) == 0, "the view ends in order"
