"""What a processor alone cannot show; skipped where torch finds no GPU."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from atlantis_exp.build import build_learner
from atlantis_exp.config import Config
from atlantis_exp.learning.learner import Learner

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU here")

every_network = pytest.mark.parametrize("model", ["cnn", "cnn_norm", "resnet", "resnet_fast"])
every_precision = pytest.mark.parametrize("precision", ["fp32", "bf16"])
every_objective = pytest.mark.parametrize("objective", ["double_dqn", "quantile"])


@pytest.fixture(name="learner")
def learner_fixture(tiny: Callable[..., Config]) -> Iterator[Callable[..., Learner]]:
    """A learner on the GPU, with batches of 32 and an average of its weights: `learner("model=resnet")`."""
    settings = torch.get_num_threads(), torch.backends.cudnn.deterministic, torch.backends.cudnn.allow_tf32

    def made(*overrides: str) -> Learner:
        common = ("device=cuda", "training.batch_size=32", "training.ema=20", "optimizer=adam")
        return build_learner(tiny(*common, *overrides))

    yield made
    threads, torch.backends.cudnn.deterministic, torch.backends.cudnn.allow_tf32 = settings
    torch.set_num_threads(threads)


def _batch(seed: int) -> tuple[Any, ...]:
    rng = np.random.default_rng(seed)
    return (
        rng.integers(0, 256, (32, 4, 40, 40), dtype=np.uint8),
        rng.integers(0, 4, 32),
        rng.choice([0, 1], 32).astype(np.float32),
        rng.integers(0, 256, (32, 4, 40, 40), dtype=np.uint8),
        np.where(rng.random(32) < 0.3, 0.0, 0.9).astype(np.float32),
    )


def _sequences(seed: int) -> tuple[Any, ...]:
    """Eight sequences of two steps before four to learn and three after them."""
    rng = np.random.default_rng(seed)
    m = rng.integers(1, 4, (8, 4))
    return (
        rng.integers(0, 256, (8, 9, 4, 40, 40), dtype=np.uint8),
        rng.integers(0, 4, 8),
        rng.integers(4, 6, 8),
        rng.integers(0, 4, (8, 4)),
        rng.choice([0, 1], (8, 4)).astype(np.float32),
        m,
        np.where(rng.random((8, 4)) < 0.3, 0.0, 0.9**m).astype(np.float32),
    )


def _on_the_processor(node: Any) -> Any:
    """A state as a checkpoint has it, with copies of its tensors."""
    if isinstance(node, dict):
        return {key: _on_the_processor(value) for key, value in node.items()}
    return node.to("cpu", copy=True) if isinstance(node, torch.Tensor) else node


@pytest.mark.parametrize("model", ["cnn", "resnet_fast"])  # ResNetDQN's dropout masks are a device's own
@every_objective
def test_updates_in_float32_are_the_processor_s(learner: Callable[..., Learner], model: str, objective: str) -> None:
    both = [
        learner(f"model={model}", f"objective={objective}", f"device={device}", "training.precision=fp32")
        for device in ("cuda", "cpu")
    ]
    for seed in range(3):
        batch = _batch(seed)
        ours, theirs = (each.q_values(batch[0]) for each in both)
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(*(each.update(*batch).cpu() for each in both), rtol=1e-3, atol=1e-3)
    weights = (_on_the_processor(each.state_dict()["network"]) for each in both)
    torch.testing.assert_close(*weights, rtol=1e-2, atol=2e-4)


@every_objective
def test_updates_of_a_memory_are_the_processor_s_and_never_wait(
    learner: Callable[..., Learner], objective: str
) -> None:
    words = (
        "model=cnn_gru",
        "model.units=8",
        "model.burn_in=2",
        "model.unroll=4",
        f"objective={objective}",
        "objective.n_step=3",
    )
    both = [learner(*words, f"device={device}", "training.precision=fp32") for device in ("cuda", "cpu")]
    for seed in range(3):
        batch = _sequences(seed)
        torch.testing.assert_close(*(each.update(*batch).cpu() for each in both), rtol=1e-3, atol=1e-3)
    weights = (_on_the_processor(each.state_dict()["network"]) for each in both)
    torch.testing.assert_close(*weights, rtol=1e-2, atol=2e-4)
    states, nothing = _batch(99)[0], np.zeros((32, 8), np.float32)
    for ours, theirs in zip(*(each.step(states, nothing) for each in both), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-2, atol=1e-3)
    torch.cuda.set_sync_debug_mode("error")
    try:
        both[0].update(*_sequences(4))
    finally:
        torch.cuda.set_sync_debug_mode("default")


@every_network
@every_precision
@every_objective
def test_the_same_updates_give_the_same_bits_and_so_do_those_of_a_restored_learner(
    learner: Callable[..., Learner], model: str, precision: str, objective: str
) -> None:
    words = (f"model={model}", f"training.precision={precision}", f"objective={objective}")
    first, second, restored = (learner(*words, f"seed={seed}") for seed in (0, 0, 1))
    for seed in range(40):
        if seed == 25:
            restored.load_state_dict(_on_the_processor(first.state_dict()))
        for each in (first, second, restored)[: 3 if seed >= 25 else 2]:
            each.update(*_batch(seed))
    states = _batch(99)[0]
    for other in (second, restored):
        torch.testing.assert_close(other.state_dict(), first.state_dict(), rtol=0, atol=0)
        np.testing.assert_array_equal(other.q_values(states), first.q_values(states))
        np.testing.assert_array_equal(other.evaluated_q_values(states), first.evaluated_q_values(states))


@every_network
@every_precision
@every_objective
def test_an_update_never_waits_for_the_gpu(
    learner: Callable[..., Learner], model: str, precision: str, objective: str
) -> None:
    busy = learner(f"model={model}", f"training.precision={precision}", f"objective={objective}")
    busy.update(*_batch(0))  # a first one allocates
    torch.cuda.set_sync_debug_mode("error")
    try:
        for seed in range(1, 21):  # the target follows and the average moves
            busy.update(*_batch(seed))
        with pytest.raises(RuntimeError, match="synchroniz"):
            busy.statistics()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.slow
@every_network
def test_compiled_updates_with_cuda_graphs_are_the_plain_ones(learner: Callable[..., Learner], model: str) -> None:
    words = (f"model={model}", "training.precision=fp32", "objective=quantile")
    both = [learner(*words, f"compile={compile}") for compile in ("false", "true")]
    for seed in range(6):
        torch.testing.assert_close(*(each.update(*_batch(seed)) for each in both), rtol=1e-3, atol=1e-3)
    plain, compiled = (each.q_values(_batch(99)[0]) for each in both)
    np.testing.assert_allclose(plain, compiled, rtol=1e-2, atol=1e-3)
