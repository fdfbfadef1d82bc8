"""How a training is asked to stop: by signals, by its time, by the end of its sweep."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from atlantis_exp.faults import Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, adopt
from atlantis_exp.sessions.page import terminable
from atlantis_exp.sessions.stopping import StopRequest, sweep_goes_on

REPOSITORY = Path(__file__).parents[2]


def test_a_second_interrupt_ends_the_process_at_once() -> None:
    stop = StopRequest()
    with stop.installed():
        signal.raise_signal(signal.SIGTERM)
        assert stop()
        with pytest.raises(SystemExit) as ended:
            stop.end("done")
    assert ended.value.code == 143
    code = (
        "import signal; from atlantis_exp.sessions.stopping import StopRequest\n"
        "with StopRequest().installed(): [signal.raise_signal(signal.SIGINT) for _ in range(2)]"
    )
    assert subprocess.run((sys.executable, "-c", code), cwd=REPOSITORY, check=False).returncode == -signal.SIGINT


def test_outside_the_main_thread_signals_keep_their_handlers() -> None:
    before = signal.getsignal(signal.SIGTERM)

    def handler() -> object:
        with StopRequest().installed(), terminable():
            return signal.getsignal(signal.SIGTERM)

    with ThreadPoolExecutor() as pool:
        assert pool.submit(handler).result() == before


@pytest.fixture
def under_slurm() -> Iterator[list[int]]:
    """The signals that reach the handler by which Slurm's launcher requeues a job."""
    tape: list[int] = []
    before = signal.signal(signal.SIGUSR2, lambda number, _: tape.append(number))
    yield tape
    signal.signal(signal.SIGUSR2, before)


def test_under_slurm_sigterm_is_a_warning_and_sigusr2_goes_on_to_the_handler_before(
    under_slurm: list[int],
) -> None:
    stop = StopRequest(under_slurm=True)
    with stop.installed():
        signal.raise_signal(signal.SIGTERM)
        assert stop()
        assert stop.was_a_warning()
        assert not stop()
        signal.raise_signal(signal.SIGUSR2)
        assert stop()
        assert not stop.was_a_warning()
        assert under_slurm == []
        with pytest.raises(SystemExit):
            stop.end("done")
    assert under_slurm == [signal.SIGUSR2]


def test_under_slurm_the_sigterm_of_time_that_is_up_does_not_undo_the_sigusr2_before_it(
    under_slurm: list[int],
) -> None:
    stop = StopRequest(under_slurm=True)
    with stop.installed():
        signal.raise_signal(signal.SIGUSR2)
        signal.raise_signal(signal.SIGTERM)  # the commit took long
        assert stop()
        assert not stop.was_a_warning()
        with pytest.raises(SystemExit):
            stop.end("done")
    assert under_slurm == [signal.SIGUSR2]


def test_the_end_of_the_time_or_of_the_sweep_is_a_fault_so_that_other_jobs_go_on() -> None:
    out_of_time, out_of_sweep = StopRequest(0), StopRequest(60, lambda: False)
    assert out_of_time()
    with pytest.raises(Fault, match=r"^budget\.wall_clock: committed$") as fault:
        out_of_time.end("committed")
    assert fault.value.exit_code == 124
    assert out_of_sweep()
    with pytest.raises(Fault, match=r"^the sweep has ended: committed$") as fault:
        out_of_sweep.end("committed")
    assert fault.value.exit_code == 143
    assert not StopRequest(60, lambda: True)()


def test_the_time_begins_with_the_first_step_so_that_a_long_set_up_does_not_end_a_session_before_it() -> None:
    stop = StopRequest(0.05)
    with stop.installed():
        time.sleep(0.1)  # the set-up
        assert not stop()
        time.sleep(0.1)
        assert stop()


def test_a_job_goes_on_while_the_process_that_launched_it_wants_it(tmp_path: Path) -> None:
    run, sweep = RunFolder(tmp_path / "runs" / "run"), RunFolder(tmp_path / "sweeps" / "sweep")
    assert sweep_goes_on(run, "joblib")()  # of no sweep
    Journal(sweep.path)
    adopt(run.path, sweep.path)

    def wanted() -> dict[str | None, bool]:
        return {launcher: sweep_goes_on(run, launcher)() for launcher in ("joblib", "slurm", None)}

    with sweep.held():
        assert wanted() == {"joblib": True, "slurm": True, None: True}
    assert wanted() == {"joblib": False, "slurm": True, None: True}
