from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from manip_il.cli.interrupt import Interrupted, StopRequest, resume_command


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_is_a_request_and_the_second_stops(number, capfd):
    with StopRequest() as stop:
        assert not stop.requested
        signal.raise_signal(number)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert capfd.readouterr().err.count("stopping after the step in hand (Ctrl-C again to stop at once)") == 1


def test_the_handlers_before_are_restored():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with StopRequest():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_outside_the_main_thread_it_reports_no_request():
    seen: list[bool] = []

    def work() -> None:
        with StopRequest() as stop:
            seen.append(stop.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]


def test_a_forked_worker_leaves_ctrl_c_to_its_parent_and_dies_of_sigterm():
    reader, writer = os.pipe()
    with StopRequest() as stop:
        child = os.fork()
        if child == 0:
            os.write(writer, b"!")
            time.sleep(600)
            os._exit(0)
        os.read(reader, 1)  # Python drops signals that reach a child before it is up
        os.kill(child, signal.SIGINT)
        os.kill(child, signal.SIGTERM)
        _, status = os.waitpid(child, 0)
        assert os.WTERMSIG(status) == signal.SIGTERM
        assert not stop.requested
    os.close(reader)
    os.close(writer)


def test_interrupted_is_not_swallowed_by_code_that_outlives_errors():
    assert not issubclass(Interrupted, Exception)


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["record"], "manip-il record --resume=true"),
        (["record", "--overwrite=true", "--seed", "1"], "manip-il record --seed 1 --resume=true"),
        (["record", "--overwrite", "true", "--resume"], "manip-il record --resume=true"),
        (["train", "--dataset.root=a b"], "manip-il train '--dataset.root=a b' --resume=true"),
    ],
)
def test_the_way_on_is_the_same_command_with_resume(words, command):
    assert resume_command(words) == command
