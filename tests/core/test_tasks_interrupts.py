"""Ctrl-C while sampling: one sentence, what was done is kept."""

from __future__ import annotations

import signal
import threading

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.tasks import interrupt_between_steps
from tests.helpers.scenes import observations


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


def test_sampling_interrupted_by_the_user_says_nothing_and_resumes(tmp_path, capsys):
    obs = observations()
    cal = sc.calibrate(obs, sc.paper.paper_start())
    options = {"seed": 4, "n_walkers": 32, "n_steps": 200}
    whole = sc.sample(obs, cal, **options)

    def press(done, total):
        if done == total // 2:
            signal.raise_signal(signal.SIGINT)

    checkpoint = tmp_path / "checkpoint.npz"
    with pytest.raises(KeyboardInterrupt):
        sc.sample(obs, cal, progress=press, checkpoint=checkpoint, **options)
    printed = capsys.readouterr()
    assert printed.out + printed.err == ""
    assert checkpoint.exists()
    resumed = sc.sample(obs, cal, checkpoint=checkpoint, **options)
    assert np.array_equal(resumed.draws, whole.draws)
