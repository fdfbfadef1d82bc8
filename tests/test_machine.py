"""What a process reads of its environment, once."""

import os

import pytest

from atlantis_exp.machine import JOB_OF, Machine, here


@pytest.mark.parametrize(("share", "cores"), [("2", 2), ("64", 3), ("", 3), ("0", 3), ("two", 3), ("9" * 5_000, 3)])
def test_a_process_has_the_cores_it_may_run_on_and_of_these_its_share(
    monkeypatch: pytest.MonkeyPatch, share: str, cores: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(3)))
    monkeypatch.setenv("OMP_NUM_THREADS", share)
    assert here().cores == cores


def test_where_the_system_does_not_say_which_cores_are_ours_all_of_them_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on macOS."""
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert here().cores == 5


def test_a_process_knows_the_launcher_that_has_started_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (JOB_OF, "SLURM_JOB_ID", "SLURM_RESTART_COUNT"):
        monkeypatch.delenv(name, raising=False)
    cores = here().cores
    assert here() == Machine(cores)
    monkeypatch.setenv(JOB_OF, "apart")
    monkeypatch.setenv("SLURM_JOB_ID", "1")
    assert here() == Machine(cores, "apart", 0)
    monkeypatch.setenv("SLURM_RESTART_COUNT", "2")
    assert here() == Machine(cores, "apart", 2)
    monkeypatch.setenv("SLURM_RESTART_COUNT", "abc")
    assert here() == Machine(cores, "apart", 0)
