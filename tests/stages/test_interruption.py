"""Signals that end a command: each unwinds it once, and none is lost where Python drops exceptions."""

import os
import signal
import threading
import time

import pytest

from sim2real.stages.terminal.interruption import SignalHandling, interruptible, patiently


def send_and_wait(number):
    os.kill(os.getpid(), number)
    time.sleep(60)  # the signal ends it


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, None), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_raises_an_exception(number, code):
    with SignalHandling() as handling, pytest.raises(KeyboardInterrupt if code is None else SystemExit) as caught:
        send_and_wait(number)
    assert handling.received == number
    assert code is None or caught.value.code == code


def test_a_second_signal_does_not_break_off_the_clean_up_but_ends_a_soft_stop(capfd):
    def stop():
        try:
            send_and_wait(signal.SIGINT)
        except KeyboardInterrupt:
            os.kill(os.getpid(), signal.SIGINT)
            with interruptible():
                send_and_wait(signal.SIGTERM)

    with SignalHandling():
        with pytest.raises(SystemExit):
            stop()
        os.kill(os.getpid(), signal.SIGINT)
    assert capfd.readouterr().err == "still cleaning up\n" * 2


class Finalised:
    """Sends SIGTERM inside its finaliser."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)


def finalise_and_wait():
    Finalised()
    for _ in range(600):  # a signal between two bytecodes does not end the next sleep
        time.sleep(0.1)


def test_a_signal_that_comes_while_python_reports_a_dropped_one_is_not_lost(monkeypatch):
    late, sent = SignalHandling._send_later, []

    def early(handling, number):
        sent.append(number)
        if len(sent) == 1:  # before the report has ended
            os.kill(os.getpid(), number)
        else:
            late(handling, number)

    monkeypatch.setattr(SignalHandling, "_send_later", early)
    with SignalHandling(), pytest.raises(SystemExit):
        finalise_and_wait()
    assert sent == [signal.SIGTERM] * 2


def test_a_signal_does_not_wait_for_a_long_computation():
    def compile_for_a_minute():
        os.kill(os.getpid(), signal.SIGINT)
        forever.wait(60)

    forever = threading.Event()
    with SignalHandling(), pytest.raises(KeyboardInterrupt):
        patiently(compile_for_a_minute)
    forever.set()
