"""Ctrl-C while sampling: one sentence, what was done is kept."""

import signal
import threading

import pytest

from starcal_uq.core.tasks import interrupt_between_steps


def test_signal_waits_for_the_check_and_the_handler_is_put_back():
    before = signal.getsignal(signal.SIGINT)
    reached = []
    with pytest.raises(KeyboardInterrupt), interrupt_between_steps() as check:
        signal.raise_signal(signal.SIGINT)
        reached.append("after the signal")
        check()
        reached.append("after the check")
    assert reached == ["after the signal"]
    assert signal.getsignal(signal.SIGINT) is before


def test_signal_after_the_last_check_is_not_lost():
    with pytest.raises(KeyboardInterrupt), interrupt_between_steps():
        signal.raise_signal(signal.SIGINT)


def test_other_threads_are_left_alone():
    outcome = []

    def work():
        with interrupt_between_steps() as check:
            check()
            outcome.append("done")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert outcome == ["done"]
