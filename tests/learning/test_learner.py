import copy
import json
from collections.abc import Callable, Iterator
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt
import pytest
import torch
from safetensors.torch import load, save
from torch import nn
from torch.nn.functional import smooth_l1_loss
from torch.utils._python_dispatch import TorchDispatchMode

from atlantis_exp.learning.learner import Learner
from atlantis_exp.learning.objectives import DQN, DoubleDQN, Objective, Quantile
from atlantis_exp.learning.values import Replicas
from atlantis_exp.networks.cnn import DQNCnn
from atlantis_exp.networks.cnn_norm import NormedCnn
from atlantis_exp.networks.dropout import seed_dropout
from atlantis_exp.networks.heads import QuantileHead
from atlantis_exp.networks.resnet import ResNetDQN

Precision = Literal["fp32", "bf16"]
Batch = tuple[
    npt.NDArray[np.uint8],
    npt.NDArray[np.int64],
    npt.NDArray[np.float32],
    npt.NDArray[np.uint8],
    npt.NDArray[np.float32],
]


class Scaled(DQNCnn):
    """A network with a parameter that is one number."""

    def __init__(self, input_shape: tuple[int, int, int], num_actions: int) -> None:
        super().__init__(input_shape, num_actions)
        self.scale = nn.Parameter(torch.tensor(1.0))

    def forward(self, states: torch.Tensor) -> torch.Tensor:
        return super().forward(states) * self.scale


_SIDE: dict[type[nn.Module], int] = {
    DQNCnn: 36,
    Scaled: 36,
    ResNetDQN: 31,
}  # pixels; small, since the tests are about the learner
every_network = pytest.mark.parametrize("network_class", [DQNCnn, ResNetDQN])
every_precision = pytest.mark.parametrize("precision", ["fp32", "bf16"])


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Threads only wait for one another in networks this small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def _networks(network_class: type[nn.Module], seed: int = 0) -> tuple[nn.Module, nn.Module]:
    """A network and a target network of other weights, so that taking one for the other shows."""
    side = _SIDE[network_class]
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network, target = network_class((4, side, side), 4), network_class((4, side, side), 4)
    seed_dropout(network, seed)
    seed_dropout(target, seed + 1)
    return network, target


def _learner(
    network_class: type[nn.Module],
    *,
    seed: int = 0,
    objective: Objective = DoubleDQN(),  # noqa: B008 - frozen
    tau: float = 0.1,
    precision: Precision = "fp32",
    target_mode: Literal["eval", "train"] = "eval",
    shards: int = 1,
    ema: int | None = None,
    compile: Callable[[nn.Module], nn.Module] | None = None,
) -> Learner:
    network, target = _networks(network_class, seed)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3, fused=True)
    return Learner(
        network,
        target,
        optimizer,
        objective,
        tau,
        precision=precision,
        target_mode=target_mode,
        shards=shards,
        ema=ema,
        compile=compile,
    )


def _batch(side: int, seed: int = 0, size: int = 6) -> Batch:
    rng = np.random.default_rng(seed)
    return (
        rng.integers(0, 256, (size, 4, side, side), dtype=np.uint8),
        rng.integers(0, 4, size),
        rng.choice([0, 1, 100], size).astype(np.float32),
        rng.integers(0, 256, (size, 4, side, side), dtype=np.uint8),
        np.where(rng.random(size) < 0.3, 0.0, 0.9).astype(np.float32),
    )


def _same(left: nn.Module, right: nn.Module) -> bool:
    pairs = zip(left.state_dict().items(), right.state_dict().items(), strict=True)
    return all(a == b and torch.equal(x, y) for (a, x), (b, y) in pairs)


def _through_disk(state: dict[str, Any]) -> dict[str, Any]:
    """Write a state dict as a checkpoint does, tensors to safetensors and the rest to JSON, and read it back."""
    tensors: dict[str, torch.Tensor] = {}

    def split(node: Any, path: str) -> Any:
        if isinstance(node, dict):
            assert all(isinstance(key, str) for key in node)
            return {key: split(value, f"{path}/{key}") for key, value in node.items()}
        if isinstance(node, torch.Tensor):
            tensors[path] = node
            return path
        assert node is None or isinstance(node, int | float)
        return node

    def join(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: join(value) for key, value in node.items()}
        return stored[node] if isinstance(node, str) else node

    plain, stored = json.loads(json.dumps(split(state, ""))), load(save(tensors))
    joined: dict[str, Any] = join(plain)
    return joined


# The update


def _reference_update(
    network: nn.Module, target: nn.Module, optimizer: torch.optim.Optimizer, batch: Batch, precision: Precision
) -> float:
    """Double DQN as the textbook has it: plain autocast, nothing cached, the soft update as a formula."""
    s_t, a_t, r_t, s_tpm, discount = (torch.from_numpy(array) for array in batch)

    def q(module: nn.Module, states: torch.Tensor) -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            values: torch.Tensor = module(states.float() / 255)
        return values.float()

    with torch.no_grad():
        a_tpm = q(network.eval(), s_tpm).argmax(1)
        v_tpm = q(target.eval(), s_tpm)[range(len(a_tpm)), a_tpm]
    errors = q(network.train(), s_t)[range(len(a_t)), a_t]
    loss = smooth_l1_loss(errors, r_t + discount * v_tpm)
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()
    old, new = target.state_dict(), network.state_dict()
    target.load_state_dict(
        {key: 0.1 * new[key] + 0.9 * old[key] if old[key].is_floating_point() else new[key] for key in old}
    )
    return loss.item()


@every_network
@every_precision
def test_an_update_is_the_textbook_s(network_class: type[nn.Module], precision: Precision) -> None:
    learner = _learner(network_class, precision=precision)
    network, target = copy.deepcopy((learner.network, learner.target))
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3, fused=True)
    for seed in range(2):
        batch = _batch(_SIDE[network_class], seed)
        learner.update(*batch)
        loss = _reference_update(network, target, optimizer, batch, precision)
        assert learner.statistics()["loss"] == pytest.approx(loss)
        # the next update must start from the same bits: the two soft updates round differently
        torch.testing.assert_close(learner.target.state_dict(), target.state_dict(), rtol=1e-6, atol=1e-7)
        assert _same(learner.network, network)
        target.load_state_dict(learner.target.state_dict())


class _Witness(nn.Module):
    """A network that writes down who was asked about which states, in which mode."""

    def __init__(self, name: str, tape: list[str]) -> None:
        super().__init__()
        self.name, self.tape = name, tape
        self.values = nn.Parameter(torch.zeros(4))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.tape.append(f"{self.name} {'trains' if self.training else 'evaluates'} {x.amax().item():.1f}")
        return self.values.expand(len(x), 4)


@pytest.mark.parametrize(
    ("objective", "target_mode", "events"),
    [
        (DQN(), "eval", ["target evaluates 1.0", "network trains 0.2"]),
        (DQN(), "train", ["target trains 1.0", "network trains 0.2"]),
        (DoubleDQN(), "eval", ["network evaluates 1.0", "target evaluates 1.0", "network trains 0.2"]),
    ],
)
def test_the_online_network_trains_on_s_t_alone(
    objective: Objective, target_mode: Literal["eval", "train"], events: list[str]
) -> None:
    tape: list[str] = []
    network, target = _Witness("network", tape), _Witness("target", tape)
    optimizer = torch.optim.SGD(network.parameters(), lr=0.1)
    learner = Learner(network, target, optimizer, objective, 0.1, target_mode=target_mode)
    s_t, s_tpm = np.full((2, 4, 1, 1), 51, np.uint8), np.full((2, 4, 1, 1), 255, np.uint8)
    learner.update(s_t, np.array([0, 1]), np.ones(2, np.float32), s_tpm, np.full(2, 0.9, np.float32))
    learner.q_values(s_t)
    assert tape == [*events, "network evaluates 0.2"]


def test_targets_send_no_gradient() -> None:
    learner = _learner(DQNCnn)
    learner.update(*_batch(36))
    assert all(parameter.grad is None for parameter in learner.target.parameters())


# Shards


@every_precision
@pytest.mark.parametrize("size", [1, 5, 6])
def test_shards_add_up_to_the_whole_batch(precision: Precision, size: int) -> None:
    whole, sharded = (_learner(DQNCnn, precision=precision, shards=shards) for shards in (1, 3))
    batch = _batch(36, size=size)
    for learner in (whole, sharded):
        learner.update(*batch)
    coarse = 2e-2 if precision == "bf16" else 1e-5
    for one, other in zip(whole.network.parameters(), sharded.network.parameters(), strict=True):
        assert one.grad is not None
        assert other.grad is not None
        torch.testing.assert_close(other.grad, one.grad, rtol=coarse, atol=coarse * float(one.grad.abs().max()))
    assert sharded.statistics() == {key: pytest.approx(value, rel=coarse) for key, value in whole.statistics().items()}
    np.testing.assert_allclose(
        sharded.q_values(batch[0]), sharded.network(torch.from_numpy(batch[0]) / 255).detach(), atol=0.02
    )


@every_precision
def test_shards_leave_no_bit_to_chance(precision: Precision) -> None:
    learners = [_learner(DQNCnn, precision=precision, shards=2) for _ in range(2)]
    for learner in learners:
        for seed in range(5):
            learner.update(*_batch(36, seed))
    torch.testing.assert_close(learners[0].state_dict(), learners[1].state_dict(), rtol=0, atol=0)


def test_a_network_whose_samples_meet_is_not_split() -> None:
    with pytest.raises(ValueError, match="without splits_batches"):
        _learner(ResNetDQN, shards=2)


# Compilation


@pytest.mark.slow
@every_network
def test_a_compiled_learner_learns_the_same(network_class: type[nn.Module]) -> None:
    """By a backend that needs no compiler; dropout masks are drawn from the same generators."""
    from torch._dynamo.testing import CompileCounterWithBackend  # takes as long to import as torch

    backend = CompileCounterWithBackend("aot_eager")
    shards = 2 if network_class is DQNCnn else 1

    def compile(network: nn.Module) -> nn.Module:
        return cast(nn.Module, torch.compile(network, backend=backend, dynamic=False))

    plain = _learner(network_class, precision="bf16", shards=shards)
    compiled = _learner(network_class, precision="bf16", shards=shards, compile=compile)
    for seed in range(3):
        batch = _batch(_SIDE[network_class], seed)
        np.testing.assert_allclose(plain.q_values(batch[0]), compiled.q_values(batch[0]), rtol=1e-3, atol=1e-5)
        errors = plain.update(*batch), compiled.update(*batch)
        torch.testing.assert_close(*errors, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(plain.state_dict(), compiled.state_dict(), rtol=1e-3, atol=1e-5)
    assert backend.frame_count >= 2 * shards  # online and target network of each


# The soft update


@pytest.mark.parametrize("tau", [1e-4, 0.3, 1.0])
def test_the_target_network_follows_by_tau(tau: float) -> None:
    learner = _learner(ResNetDQN, tau=tau)
    before = copy.deepcopy(learner.target.state_dict())
    learner.update(*_batch(31))
    after, network = learner.target.state_dict(), learner.network.state_dict()
    for key, old in before.items():
        if old.is_floating_point():
            expected = tau * network[key].double() + (1 - tau) * old.double()
            torch.testing.assert_close(after[key].double(), expected, rtol=1e-6, atol=1e-7)
        else:
            assert torch.equal(after[key], network[key])


def test_a_target_in_train_mode_keeps_running_statistics_of_its_own() -> None:
    learner = _learner(ResNetDQN, target_mode="train", objective=DQN(), tau=1.0)
    s_t, a_t, r_t, s_tpm, discount = _batch(31)
    stream = learner.target.get_submodule("regression.0").generator
    assert isinstance(stream, torch.Generator)
    before = stream.get_state()
    learner.update(s_t, a_t, r_t, s_tpm, discount)
    assert not torch.equal(stream.get_state(), before)
    for ours, theirs in zip(learner.target.parameters(), learner.network.parameters(), strict=True):
        assert torch.equal(ours, theirs)
    # the first normalisation saw s_tpm through the target's own first weights, not s_t through the network's
    mean, other = (
        learner.target.get_buffer("block1.2.running_mean"),
        learner.network.get_buffer("block1.2.running_mean"),
    )
    assert not torch.equal(mean, other)
    assert int(learner.target.get_buffer("block1.2.num_batches_tracked")) == 1


# The average


@every_network
@pytest.mark.thinned(2)
def test_the_evaluated_network_is_a_mean_of_all_weights_first_and_an_exponential_one_then(
    network_class: type[nn.Module],
) -> None:
    learner = _learner(network_class, ema=40)
    batch = _batch(_SIDE[network_class])
    snapshots = []
    for _ in range(7):
        for _ in range(10):
            learner.update(*batch)
        snapshots.append(copy.deepcopy(learner.network.state_dict()))
    for key, average in learner.evaluated.state_dict().items():
        if not average.is_floating_point():
            torch.testing.assert_close(average, snapshots[-1][key])
            continue
        expected = torch.stack([snapshot[key].double() for snapshot in snapshots[:4]]).mean(0)
        for snapshot in snapshots[4:]:
            expected = 0.75 * expected + 0.25 * snapshot[key].double()
        torch.testing.assert_close(average.double(), expected, rtol=1e-5, atol=1e-7)


def test_an_average_that_begins_with_given_weights_keeps_them_also_across_a_restart() -> None:
    learner, again = (_learner(DQNCnn, ema=40) for _ in range(2))
    given = copy.deepcopy(learner.network.state_dict())
    learner.begin_with(given)
    batch = _batch(_SIDE[DQNCnn])
    expected = {key: value.double() for key, value in given.items()}
    for part in (learner, again):
        for _ in range(2):
            for _ in range(10):
                part.update(*batch)
            for key, value in part.network.state_dict().items():
                expected[key] = 0.75 * expected[key] + 0.25 * value.double()
        again.load_state_dict(copy.deepcopy(part.state_dict()))
    for key, average in again.evaluated.state_dict().items():
        torch.testing.assert_close(average.double(), expected[key], rtol=1e-5, atol=1e-7)


@every_network
@every_precision
@pytest.mark.thinned(4)
def test_an_average_changes_neither_learning_nor_acting(network_class: type[nn.Module], precision: Precision) -> None:
    shards = 2 if network_class is DQNCnn else 1
    plain, averaged = (_learner(network_class, precision=precision, shards=shards, ema=ema) for ema in (None, 20))
    for seed in range(21):
        batch = _batch(_SIDE[network_class], seed)
        for learner in (plain, averaged):
            learner.update(*batch)
    np.testing.assert_array_equal(plain.q_values(batch[0]), averaged.q_values(batch[0]))
    state = averaged.state_dict()
    evaluated = state.pop("evaluated")
    torch.testing.assert_close(state, plain.state_dict(), rtol=0, atol=0)

    alone = _learner(network_class, precision=precision, shards=shards)
    alone.load_state_dict({**plain.state_dict(), "network": evaluated})
    np.testing.assert_array_equal(averaged.evaluated_q_values(batch[0]), alone.q_values(batch[0]))
    assert not np.array_equal(averaged.evaluated_q_values(batch[0]), averaged.q_values(batch[0]))
    np.testing.assert_array_equal(plain.evaluated_q_values(batch[0]), plain.q_values(batch[0]))


# Acting


@every_network
@every_precision
def test_acting_changes_nothing(network_class: type[nn.Module], precision: Precision) -> None:
    learner = _learner(network_class, precision=precision)
    states, *_ = batch = _batch(_SIDE[network_class])
    learner.update(*batch)
    before = copy.deepcopy(learner.state_dict())
    modes = [module.training for module in learner.network.modules()]
    first = learner.q_values(states)
    assert first.dtype == np.float32
    assert first.shape == (6, 4)
    np.testing.assert_array_equal(learner.q_values(states), first)
    assert [module.training for module in learner.network.modules()] == modes
    torch.testing.assert_close(learner.state_dict(), before, rtol=0, atol=0)


@every_network
@every_precision
def test_values_are_the_latest_eval_mode_network_s_of_scaled_states(
    network_class: type[nn.Module], precision: Precision
) -> None:
    learner = _learner(network_class, precision=precision)
    states, *_ = batch = _batch(_SIDE[network_class])
    learner.update(*batch)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
        expected = copy.deepcopy(learner.network).eval()(torch.from_numpy(states) / 255).float()
    np.testing.assert_array_equal(learner.q_values(states), expected.numpy())


# Randomness


def test_no_global_generator_is_moved() -> None:
    learner = _learner(ResNetDQN)
    before = torch.get_rng_state()
    learner.update(*_batch(31))
    learner.q_values(_batch(31)[0])
    assert torch.equal(torch.get_rng_state(), before)


def test_the_dropout_seed_is_all_that_tells_two_equal_learners_apart() -> None:
    learner, twin, other = _learner(ResNetDQN), _learner(ResNetDQN), _learner(ResNetDQN)
    seed_dropout(other.network, 99)
    for each in (learner, twin, other):
        each.update(*_batch(31))
    assert _same(learner.network, twin.network)
    assert not _same(learner.network, other.network)


# Statistics


def test_statistics_are_means_since_the_last_call() -> None:
    learner = _learner(DQNCnn)
    batches = [_batch(36, seed) for seed in range(3)]
    assert learner.statistics() == {}
    learner.update(*batches[0])
    learner.statistics()
    single = copy.deepcopy(learner)
    seen = []
    for batch in batches[1:]:
        single.update(*batch)
        seen.append(single.statistics())
        learner.update(*batch)
    assert learner.statistics() == {key: pytest.approx((seen[0][key] + seen[1][key]) / 2) for key in seen[0]}
    assert learner.statistics() == {}
    assert learner.updates == 3


def test_each_statistic_is_what_its_name_says() -> None:
    network, target = _Witness("network", []), _Witness("target", [])
    network.load_state_dict({"values": torch.tensor([1.0, 2, 3, 4])})
    target.load_state_dict({"values": torch.tensor([5.0, 6, 7, 8])})
    learner = Learner(network, target, torch.optim.SGD(network.parameters(), lr=0.1), DQN(), 0.1)
    states = np.zeros((2, 4, 1, 1), np.uint8)
    learner.update(states, np.array([0, 1]), np.array([0, 10], np.float32), states, np.array([0.5, 0.0]))
    assert learner.statistics() == {
        "loss": (2.5 + 7.5) / 2,  # |1 - 4| and |2 - 10|, less a half each
        "q": 2.5,
        "target": (0.5 * 8 + 10) / 2,
        "gradient_norm": pytest.approx(0.5**0.5),  # half a step for each of two values
    }


class _Tape(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Writes down every operation that reaches the device."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.events: list[str] = []

    def __torch_dispatch__(self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.events.append(str(func))
        return func(*args, **(kwargs or {}))


def test_an_update_never_waits_for_the_device() -> None:
    learner = _learner(ResNetDQN)
    with _Tape() as tape:
        learner.update(*_batch(31))
        assert "aten.convolution_backward.default" in tape.events
        assert "aten._local_scalar_dense.default" not in tape.events
        learner.statistics()
        learner.first_nonfinite_update()
        assert "aten._local_scalar_dense.default" in tape.events


@pytest.mark.parametrize("poison", [np.inf, np.nan])
def test_the_first_loss_that_is_no_number_is_remembered(poison: float) -> None:
    learner = _learner(DQNCnn)
    s_t, a_t, r_t, s_tpm, discount = _batch(36)
    learner.update(s_t, a_t, r_t, s_tpm, discount)
    assert learner.first_nonfinite_update() is None
    for _ in range(2):
        learner.update(s_t, a_t, np.full_like(r_t, poison), s_tpm, discount)
    assert learner.first_nonfinite_update() == 1
    restored = _learner(DQNCnn)
    restored.load_state_dict(_through_disk(learner.state_dict()))
    assert restored.first_nonfinite_update() == 1
    assert not np.isfinite(learner.statistics()["loss"])


# Continuing


@every_network
@every_precision
@pytest.mark.parametrize(
    ("target_mode", "ema"),
    [
        ("eval", 15),
        ("train", None),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("eval", None), ("train", 15))),
    ],
)
@pytest.mark.thinned(4)
def test_a_restored_learner_continues_bit_for_bit(
    network_class: type[nn.Module], precision: Precision, target_mode: Literal["eval", "train"], ema: int | None
) -> None:
    def learner(seed: int) -> Learner:
        shards = 2 if network_class is DQNCnn else 1
        return _learner(network_class, seed=seed, precision=precision, target_mode=target_mode, shards=shards, ema=ema)

    batches = [_batch(_SIDE[network_class], seed) for seed in range(21 if ema else 4)]
    unbroken, restored = learner(0), learner(10)
    unbroken.learning_rate = 3e-4
    for batch in batches[:-2]:
        unbroken.update(*batch)
    saved = _through_disk(unbroken.state_dict())
    restored.load_state_dict(saved)
    for batch in batches[-2:]:
        np.testing.assert_array_equal(unbroken.q_values(batch[0]), restored.q_values(batch[0]))
        np.testing.assert_array_equal(unbroken.evaluated_q_values(batch[0]), restored.evaluated_q_values(batch[0]))
        unbroken.update(*batch)
        restored.update(*batch)
    torch.testing.assert_close(unbroken.state_dict(), restored.state_dict(), rtol=0, atol=0)
    assert unbroken.statistics() == restored.statistics()
    assert restored.updates == len(batches)
    assert restored.learning_rate == 3e-4


@every_network
@pytest.mark.parametrize("updates", [0, 11])
@pytest.mark.thinned(2)
def test_a_block_may_update_a_learner_that_is_then_the_one_before(network_class: type[nn.Module], updates: int) -> None:
    side, shards = _SIDE[network_class], 2 if network_class is DQNCnn else 1
    learner, untouched = (_learner(network_class, precision="bf16", shards=shards, ema=15) for _ in range(2))
    for seed in range(updates):
        learner.update(*_batch(side, seed))
        untouched.update(*_batch(side, seed))
    with learner.restored():
        learner.learning_rate = 1.0
        learner.update(*_batch(side, 20))
        assert learner.updates == updates + 1
    torch.testing.assert_close(learner.state_dict(), untouched.state_dict(), rtol=0, atol=0)
    for each in (learner, untouched):
        each.update(*_batch(side, 21))
    torch.testing.assert_close(learner.state_dict(), untouched.state_dict(), rtol=0, atol=0)
    assert learner.statistics() == untouched.statistics()


@every_network
def test_to_count_the_operations_of_an_update_changes_nothing_and_threads_and_compilation_count_the_same(
    network_class: type[nn.Module],
) -> None:
    side, shards = _SIDE[network_class], 2 if network_class is DQNCnn else 1
    counted, untouched = (_learner(network_class, target_mode="train") for _ in range(2))
    for each in (counted, untouched):
        each.update(*_batch(side))
    flops = counted.update_flops((4, side, side), 6)
    assert flops > 0
    assert counted.update_flops((4, side, side), 12) == 2 * flops
    for each in (counted, untouched):
        each.update(*_batch(side, 1))
    torch.testing.assert_close(counted.state_dict(), untouched.state_dict(), rtol=0, atol=0)
    assert counted.statistics() == untouched.statistics()
    assert _learner(network_class, shards=shards).update_flops((4, side, side), 6) == flops

    def compile(_: nn.Module) -> nn.Module:
        return nn.Identity()  # which would count nothing, and fail

    assert _learner(network_class, compile=compile).update_flops((4, side, side), 6) == flops


def test_a_loaded_state_stays_the_caller_s() -> None:
    learner, restored = _learner(DQNCnn), _learner(DQNCnn, seed=10)
    learner.update(*_batch(36))
    state = learner.state_dict()
    restored.load_state_dict(state)
    before = copy.deepcopy(state)
    restored.update(*_batch(36, 1))
    torch.testing.assert_close(state, before, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("network_class", "optimizer_class"),
    [
        *((DQNCnn, optimizer_class) for optimizer_class in (torch.optim.Adam, torch.optim.RMSprop)),
        *((Scaled, optimizer_class) for optimizer_class in (torch.optim.AdamW, torch.optim.RMSprop)),
    ],
)
def test_other_optimizers_and_networks_continue_too(
    network_class: type[nn.Module], optimizer_class: type[torch.optim.Optimizer]
) -> None:
    def learner(seed: int) -> Learner:
        network, target = _networks(network_class, seed)
        optimizer = optimizer_class(network.parameters(), lr=1e-3)  # type: ignore[call-arg]
        return Learner(network, target, optimizer, DQN(), 0.1)

    unbroken, restored = learner(0), learner(10)
    unbroken.update(*_batch(36))
    restored.load_state_dict(_through_disk(unbroken.state_dict()))
    unbroken.update(*_batch(36, 1))
    restored.update(*_batch(36, 1))
    torch.testing.assert_close(unbroken.state_dict(), restored.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("change", ["missing", "shape", "no tensor"])
def test_an_optimizer_state_that_does_not_fit_is_refused(change: str) -> None:
    learner = _learner(DQNCnn)
    learner.update(*_batch(36))
    state = _through_disk(learner.state_dict())
    kept = state["optimizer"]["1"]
    match change:
        case "missing":
            del kept["exp_avg"]
        case "shape":
            kept["exp_avg"] = kept["exp_avg"][1:]
        case "no tensor":
            kept["exp_avg"] = 1.0
    with pytest.raises(ValueError, match="the optimizer's state does not fit its parameters"):
        _learner(DQNCnn, seed=10).load_state_dict(state)


def test_the_learning_rate_reaches_every_parameter_group() -> None:
    network, target = _networks(DQNCnn)
    groups = [{"params": [parameter]} for parameter in network.parameters()]
    learner = Learner(network, target, torch.optim.AdamW(groups, lr=1e-3), DQN(), 0.1)
    learner.learning_rate = 3e-4
    assert learner.learning_rate == 3e-4
    assert {group["lr"] for group in learner.optimizer.param_groups} == {3e-4}


# The quantile objective and the hard target


@every_precision
def test_a_quantile_learner_learns_one_batch_by_heart_and_acts_by_means(precision: Precision) -> None:
    def network(seed: int) -> nn.Module:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return DQNCnn((4, 36, 36), 4, lambda features, actions: QuantileHead(features, actions, 5))

    online = network(0)
    optimizer = torch.optim.Adam(online.parameters(), lr=1e-3)
    learner = Learner(online, network(1), optimizer, Quantile(5), 1.0, target_every=10, precision=precision)
    s_t, a_t, r_t, s_tpm, _ = _batch(36)
    r_t = r_t.clip(0, 1)
    for _ in range(80):
        learner.update(s_t, a_t, r_t, s_tpm, np.zeros(6, np.float32))
    assert learner.q_values(s_t).shape == (6, 4)
    np.testing.assert_allclose(learner.q_values(s_t)[range(6), a_t], r_t, atol=0.1)


def test_a_hard_target_is_copied_every_so_many_updates_and_stays_in_between() -> None:
    network, target = _networks(ResNetDQN)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3, fused=True)
    learner = Learner(network, target, optimizer, DQN(), 1.0, target_every=3)
    before = copy.deepcopy(target)
    for update in range(1, 8):
        learner.update(*_batch(31, update))
        if update in (3, 6):
            assert _same(target, network)
            before = copy.deepcopy(target)
        assert _same(target, before)


def test_acting_follows_every_update_though_the_target_stays() -> None:
    network, target = _networks(DQNCnn)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    learner = Learner(network, target, optimizer, DQN(), 1.0, target_every=100, precision="bf16")
    states, *_ = batch = _batch(36)
    learner.update(*batch)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        expected = copy.deepcopy(learner.network).eval()(torch.from_numpy(states) / 255).float()
    np.testing.assert_array_equal(learner.q_values(states), expected.numpy())


def test_in_bfloat16_all_layers_but_batch_normalization_are_cast() -> None:
    """By what torch's authors say, a GPU refuses layer normalization whose weights are of another type."""
    for made in (NormedCnn((2, 36, 36), 3), ResNetDQN((2, 36, 36), 3)):
        (replica,) = Replicas(made, torch.bfloat16, 1).networks
        for module in replica.modules():
            dtype = torch.float32 if isinstance(module, nn.BatchNorm2d) else torch.bfloat16
            assert {each.dtype for each in module.parameters(recurse=False)} <= {dtype}


# Weights and errors


def test_weights_count_in_the_loss_and_a_sample_of_weight_0_teaches_nothing() -> None:
    weighted, twin = _learner(DQNCnn), _learner(DQNCnn)
    batch = _batch(36)
    weighted.update(*batch, weights=np.array([0.5] * 6))
    twin.objective = _Halved()
    twin.update(*batch)
    torch.testing.assert_close(weighted.network.state_dict(), twin.network.state_dict())
    still = _learner(DQNCnn)
    before = copy.deepcopy(still.network.state_dict())
    still.optimizer = torch.optim.SGD(still.network.parameters(), lr=1.0)
    still.update(*batch, weights=np.zeros(6))
    torch.testing.assert_close(still.network.state_dict(), before)


class _Halved(DoubleDQN):
    def losses(self, q: torch.Tensor, a_t: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return super().losses(q, a_t, target) / 2


def test_an_update_returns_how_far_each_value_was_off_its_target() -> None:
    learner = _learner(DQNCnn)
    s_t, a_t, r_t, s_tpm, _ = _batch(36)
    q_BA = learner.q_values(s_t)
    errors = learner.update(s_t, a_t, r_t, s_tpm, np.zeros(6, np.float32))
    np.testing.assert_allclose(errors.numpy(), np.abs(r_t - q_BA[range(6), a_t]), rtol=1e-5)


def test_batches_go_where_the_network_is_on_any_device() -> None:
    learner = _learner(DQNCnn)
    learner.device = torch.device("meta")  # which is no CPU and no CUDA device, as Apple's is
    assert learner._sent(np.zeros(3, np.float32)).device.type == "meta"


@every_precision
@pytest.mark.parametrize("shards", [1, 2])
def test_a_frozen_layer_stays_as_it_is_and_the_others_learn(precision: Precision, shards: int) -> None:
    network, target = _networks(DQNCnn)
    first, *others = network.parameters()
    first.requires_grad_(False)
    before = copy.deepcopy([first, *others])
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    Learner(network, target, optimizer, DQN(), 0.1, precision=precision, shards=shards).update(*_batch(_SIDE[DQNCnn]))
    moved = [not torch.equal(old, new) for old, new in zip(before, network.parameters(), strict=True)]
    assert moved == [False, *(True for _ in others)]


def test_a_layer_that_nothing_asks_learns_nothing() -> None:
    network, target = _networks(DQNCnn)
    unused = nn.Linear(3, 2)
    network.add_module("unused", unused)
    target.add_module("unused", copy.deepcopy(unused))
    before = copy.deepcopy(unused.weight)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    Learner(network, target, optimizer, DQN(), 0.1).update(*_batch(_SIDE[DQNCnn]))
    assert torch.equal(before, unused.weight)
