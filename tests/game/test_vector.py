import copy
import functools
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from atlantis_exp.build import build_game
from atlantis_exp.components import known
from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import Pixels, Preprocessing
from atlantis_exp.game.vector import Emulators, ProcessEmulators, SerialEmulators, Steps, WorkerDied, make_emulators

ATLANTIS = build_game(known("env")["atlantis"])
make = functools.partial(
    Emulator,
    game=ATLANTIS,
    preprocessing=Preprocessing(32, (14, 160, 94, 0)),
    frameskip=(2, 5),
    sticky=0.25,
    max_frames=300,
    max_steps=None,
    noop_max=0,
    max_pool=False,
)

NUM_ENVS = 3


def assert_equal(one: Steps, other: Steps) -> None:
    for column, others in zip(one, other, strict=True):
        np.testing.assert_array_equal(column, others, strict=True)


def play(emulators: Emulators, steps: int, seed: int) -> list[Steps | Pixels]:
    """Plays at random; every third step leaves one environment out, and the order of the others is any."""
    rng = np.random.default_rng(seed)
    seen: list[Steps | Pixels] = []
    for step in range(steps):
        envs = rng.permutation(NUM_ENVS)[: 2 if step % 3 == 2 else None]
        steps_of_envs = emulators.step(rng.integers(4, size=len(envs)), envs)
        seen += [steps_of_envs, emulators.reset(envs[steps_of_envs.terminated | steps_of_envs.truncated])]
    return seen


def assert_all_equal(one: list[Steps | Pixels], other: list[Steps | Pixels]) -> None:
    for first, second in zip(one, other, strict=True):
        if isinstance(first, Steps):
            assert isinstance(second, Steps)
            assert_equal(first, second)
        else:
            np.testing.assert_array_equal(first, second, strict=True)


def test_workers_change_nothing() -> None:
    seeds = [7, 2**40, 3]
    serial = SerialEmulators(make, NUM_ENVS)
    first = serial.reset(range(NUM_ENVS), seeds)
    played = play(serial, 110, seed=0)
    state = serial.state_dict()
    for workers in (1, 2, 3):
        with ProcessEmulators(make, NUM_ENVS, workers) as processes:
            np.testing.assert_array_equal(processes.reset(range(NUM_ENVS), seeds), first, strict=True)
            assert_all_equal(play(processes, 110, seed=0), played)
            np.testing.assert_equal(processes.state_dict(), state)


def test_each_environment_is_its_own_emulator() -> None:
    with SerialEmulators(make, 3) as emulators:
        alone = [make() for _ in range(3)]
        first = emulators.reset([2, 0, 1], seeds=[12, 10, 11])
        np.testing.assert_array_equal(first, [alone[env].reset(seed=10 + env) for env in (2, 0, 1)])
        for _ in range(60):
            steps = emulators.step([1, 2, 3])
            for env, emulator in enumerate(alone):
                step = emulator.step(1 + env)
                np.testing.assert_array_equal(steps.observations[env], step.observation)
                assert tuple(column[env].tolist() for column in steps[1:]) == step[1:]


@pytest.fixture(scope="module")
def in_process() -> SerialEmulators:
    return SerialEmulators(make, NUM_ENVS)


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)


@pytest.fixture(scope="module")
def two_workers() -> Iterator[ProcessEmulators]:
    with ProcessEmulators(make, NUM_ENVS, workers=2) as emulators:
        emulators.reset(range(NUM_ENVS), seeds=range(NUM_ENVS))
        yield emulators


@pytest.fixture(params=["in_process", "two_workers"])
def emulators(request: pytest.FixtureRequest) -> Emulators:
    played: Emulators = request.getfixturevalue(request.param)
    played.reset(range(NUM_ENVS))
    return played


def test_what_was_returned_is_not_overwritten(emulators: Emulators) -> None:
    first = emulators.reset(range(NUM_ENVS))
    steps = emulators.step([1] * NUM_ENVS)
    kept = copy.deepcopy((first, steps))
    play(emulators, 20, seed=1)
    np.testing.assert_array_equal(first, kept[0])
    assert_equal(steps, kept[1])


def test_saved_emulators_play_on_under_any_number_of_workers(emulators: Emulators) -> None:
    play(emulators, 40, seed=2)
    state = emulators.state_dict()
    played = play(emulators, 100, seed=3)
    for restored in (emulators, SerialEmulators(make, NUM_ENVS)):
        restored.load_state_dict(dict(reversed(state.items())))
        assert_all_equal(play(restored, 100, seed=3), played)


def test_steps_of_other_environments_can_be_under_way(emulators: Emulators) -> None:
    state = emulators.state_dict()
    emulators.send([1, 2], [2, 0])
    emulators.send([3], [1])
    first = emulators.receive()
    begun = emulators.reset([2], [7])  # while the second step is under way
    emulators.send([3], [0])
    second, third = emulators.receive(), emulators.receive()
    emulators.load_state_dict(state)
    assert_equal(first, emulators.step([1, 2], [2, 0]))
    assert_equal(second, emulators.step([3], [1]))
    np.testing.assert_array_equal(begun, emulators.reset([2], [7]))
    assert_equal(third, emulators.step([3], [0]))


def test_calls_out_of_turn_are_refused(emulators: Emulators) -> None:
    with pytest.raises(RuntimeError, match="no step was sent"):
        emulators.receive()
    emulators.send([0] * NUM_ENVS)
    for call in (
        *(emulators.state_dict, lambda: emulators.reset([0])),
        *(lambda: emulators.send([0], [0]), lambda: emulators.step([0], [0])),
    ):
        with pytest.raises(RuntimeError, match="sent and not received"):
            call()
    emulators.receive()
    with pytest.raises(RuntimeError, match="no step was sent"):
        emulators.receive()


def test_actions_and_seeds_must_match_environments(emulators: Emulators) -> None:
    with pytest.raises(ValueError, match="zip"):
        emulators.step([0] * (NUM_ENVS + 1))
    with pytest.raises(ValueError, match="zip"):
        emulators.reset([0], seeds=[1, 2])
    assert len(emulators.step([0] * NUM_ENVS).rewards) == NUM_ENVS


def test_one_environment_or_no_worker_stays_in_this_process() -> None:
    assert isinstance(make_emulators(make, 1, workers=2), SerialEmulators)
    assert isinstance(make_emulators(make, 2, workers=0), SerialEmulators)
    before = workers_of_this_process()
    with make_emulators(make, 2, workers=3) as emulators:
        assert isinstance(emulators, ProcessEmulators)
        assert len(workers_of_this_process() - before) == 2


def workers_of_this_process() -> set[int]:
    return {child.pid for child in multiprocessing.active_children() if child.pid}


@pytest.fixture
def mortal() -> Iterator[tuple[ProcessEmulators, list[int]]]:
    """Emulators and the processes of their worker 0, which plays environments 0 and 2, and worker 1."""
    before = workers_of_this_process()
    with ProcessEmulators(make, NUM_ENVS, workers=2) as emulators:
        emulators.reset(range(NUM_ENVS))
        yield emulators, sorted(workers_of_this_process() - before)
        assert workers_of_this_process() == before


def test_a_worker_killed_between_steps_is_named(mortal: tuple[ProcessEmulators, list[int]]) -> None:
    emulators, (victim, _) = mortal
    os.kill(victim, signal.SIGKILL)
    await_end([victim])
    with pytest.raises(WorkerDied, match=r"worker 0, environments \[0, 2\], died of SIGKILL"):
        emulators.step([0] * NUM_ENVS)


def test_a_worker_killed_in_a_step_is_named_and_the_others_end(mortal: tuple[ProcessEmulators, list[int]]) -> None:
    emulators, (victim, other) = mortal
    os.kill(victim, signal.SIGSTOP)
    os.kill(other, signal.SIGSTOP)
    emulators.send([0] * NUM_ENVS)
    os.kill(victim, signal.SIGKILL)
    with pytest.raises(WorkerDied, match=r"worker 0, environments \[0, 2\], died of SIGKILL"):
        emulators.receive()


@pytest.mark.parametrize("is_asked_to_stop", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_worker_that_hangs_is_named_and_the_others_end(
    mortal: tuple[ProcessEmulators, list[int]], monkeypatch: pytest.MonkeyPatch, is_asked_to_stop: bool
) -> None:
    emulators, (victim, _) = mortal
    monkeypatch.setattr("atlantis_exp.game.vector._LAST_SECONDS", 2)
    emulators.patience = 60 if is_asked_to_stop else 2
    emulators.stop = lambda: is_asked_to_stop
    os.kill(victim, signal.SIGSTOP)
    began = time.monotonic()
    with pytest.raises(WorkerDied, match=r"worker 0, environments \[0, 2\], hangs: no answer and no work for \d s"):
        emulators.step([0] * NUM_ENVS)
    assert time.monotonic() - began < 40
    assert not workers_of_this_process() & {victim}


def test_a_worker_that_works_for_longer_than_one_may_hang_is_waited_for() -> None:
    with ProcessEmulators(functools.partial(make, max_frames=10**6), 2, workers=2) as emulators:
        emulators.reset(range(2), [0, 1])
        state = emulators.state_dict()
        emulators.patience = 0.05  # seconds; playing the episode again takes several times as long
        state["0"]["actions"] = np.zeros(12_000, np.uint8)
        emulators.load_state_dict(state)
        assert emulators.state_dict()["0"]["actions"].size == 12_000


def test_an_exception_in_a_worker_is_told(mortal: tuple[ProcessEmulators, list[int]]) -> None:
    emulators, _ = mortal
    with pytest.raises(WorkerDied, match=r"worker 0, environments \[0, 2\], died of IndexError\('list index out of"):
        emulators.step([0, 0, 99])


def test_what_make_raises_is_raised() -> None:
    with pytest.raises(ValueError, match="max_pool"):
        ProcessEmulators(functools.partial(make, max_pool=True, frameskip=1), 2, 2)


def test_workers_leave_signals_to_the_parent_from_their_start_on() -> None:
    before = workers_of_this_process()
    with ProcessEmulators(make, NUM_ENVS, workers=2) as emulators:
        for number in SIGNALS:
            for pid in workers_of_this_process() - before:
                os.kill(pid, number)
        assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(SIGNALS)
        assert emulators.reset(range(NUM_ENVS)).any()


PARENT = """
import functools, multiprocessing, sys
from atlantis_exp.components import facts_of, game_of
from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import Preprocessing
from atlantis_exp.game.vector import ProcessEmulators

make = functools.partial(Emulator, preprocessing=Preprocessing(84, (0, 160, 210, 0)), frameskip=4, sticky=0.25,
                         max_frames=1_000, max_steps=None, noop_max=0, max_pool=False,
                         game=facts_of(game_of("Atlantis-v0")))
emulators = ProcessEmulators(make, 2, 2)
emulators.reset([0, 1])
print(*[child.pid for child in multiprocessing.active_children()], flush=True)
"""


def await_end(pids: list[int]) -> None:
    deadline = time.monotonic() + 60
    for pid in pids:
        status = Path(f"/proc/{pid}/stat")
        while status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z":
            assert time.monotonic() < deadline, f"worker {pid} has outlived its parent"
            time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("busy", ["sys.stdin.read()", "emulators.send([0, 0]); sys.stdin.read()"])
def test_workers_and_their_memory_do_not_outlive_a_killed_parent(busy: str) -> None:
    shared_before = set(os.listdir("/dev/shm"))
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT + busy], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert parent.stdout is not None
    pids = [int(pid) for pid in parent.stdout.readline().split()]
    assert len(pids) == 2
    parent.kill()
    _, complaints = parent.communicate()
    await_end(pids)
    assert complaints == b""
    assert set(os.listdir("/dev/shm")) <= shared_before


def test_a_script_is_not_run_again_in_the_workers(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(f"print('once')\n{PARENT}")
    ran = subprocess.run([sys.executable, tmp_path / "script.py"], capture_output=True, check=True, timeout=60)
    assert ran.stdout.count(b"once") == 1
    assert ran.stderr == b""


def test_a_parent_that_forgets_to_close_ends_in_silence() -> None:
    told = subprocess.run([sys.executable, "-c", PARENT], capture_output=True, check=True, timeout=60)
    assert told.stderr == b""
    await_end([int(pid) for pid in told.stdout.split()])


def test_workers_import_nothing_but_this_wing_what_a_fault_is_and_what_pays_points() -> None:
    code = "import sys, atlantis_exp.game.atlantis, atlantis_exp.game.vector; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout.split()
    ours = {name for name in modules if name.startswith("atlantis_exp.")}
    assert ours == {"atlantis_exp.game", "atlantis_exp.faults", "atlantis_exp.games"} | {
        f"atlantis_exp.game.{room}" for room in ("atlantis", "preprocessing", "emulator", "vector")
    }
    assert not {"torch", "mlflow", "hydra", "omegaconf", "matplotlib"} & set(modules)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
@pytest.mark.parametrize("spare", [0, 1])
def test_workers_stay_on_a_core_each_unless_cores_are_left_over(spare: int) -> None:
    mine = sorted(os.sched_getaffinity(0))
    workers = len(mine) - spare
    if workers < 1:
        pytest.skip("needs two cores")
    with make_emulators(make, workers + 1, workers) as emulators:
        assert isinstance(emulators, ProcessEmulators)
        emulators.reset(range(workers + 1))
        cores = [os.sched_getaffinity(process.pid or 0) for process in emulators._processes]
    assert cores == ([set(mine)] * workers if spare else [{core} for core in mine])
