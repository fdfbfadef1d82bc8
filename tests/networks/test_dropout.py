import pytest
import torch
from torch import nn

from atlantis_exp.networks.dropout import Dropout, seed_dropout


def _seeded(p: float, seed: int) -> Dropout:
    dropout = Dropout(p)
    dropout.generator.manual_seed(seed)
    return dropout


def test_in_eval_mode_it_is_the_identity_and_draws_nothing() -> None:
    dropout = _seeded(0.5, 1).eval()
    before = dropout.generator.get_state()
    x = torch.rand(4, 5)
    assert dropout(x) is x
    assert torch.equal(dropout.generator.get_state(), before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_what_is_kept_is_scaled_up_and_the_rest_is_zero(dtype: torch.dtype) -> None:
    x = torch.rand(200, 100).add(1).to(dtype)
    y = _seeded(0.3, 2)(x)
    kept = y != 0
    assert y.dtype is dtype
    torch.testing.assert_close(y[kept], x[kept] / 0.7)
    # 20,000 draws of probability 0.7: five standard deviations are 0.016
    assert abs(kept.float().mean().item() - 0.7) < 0.016


def test_masks_follow_the_seed_and_differ_from_call_to_call() -> None:
    x = torch.ones(1000)
    dropout, twin, other = _seeded(0.2, 3), _seeded(0.2, 3), _seeded(0.2, 4)
    first, second = dropout(x), dropout(x)
    assert torch.equal(first, twin(x))
    assert not torch.equal(first, second)
    assert not torch.equal(first, other(x))


def test_the_global_generator_is_neither_read_nor_moved() -> None:
    x = torch.ones(1000)
    with torch.random.fork_rng():
        torch.manual_seed(6)
        before = torch.get_rng_state()
        first = _seeded(0.2, 7)(x)
        assert torch.equal(torch.get_rng_state(), before)
        torch.manual_seed(8)
        assert torch.equal(_seeded(0.2, 7)(x), first)


def test_gradients_pass_where_values_passed() -> None:
    x = torch.ones(1000, requires_grad=True)
    y = _seeded(0.2, 9)(x)
    y.sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad, y.detach())


def test_one_seed_seeds_every_dropout_of_a_network_and_nothing_of_its_copy() -> None:
    network = nn.Sequential(nn.Linear(8, 8), Dropout(0.5), nn.Sequential(Dropout(0.5)))
    copy = nn.Sequential(nn.Linear(8, 8), Dropout(0.5), nn.Sequential(Dropout(0.5)))
    copy.load_state_dict(network.state_dict())
    seed_dropout(network, 1)
    seed_dropout(copy, 1)
    x = torch.rand(16, 8)
    first = network(x)
    assert not torch.equal(network(x), first)
    assert torch.equal(copy(x), first)


def test_a_network_shares_one_stream_between_its_layers_so_their_masks_differ() -> None:
    network = nn.Sequential(nn.Linear(1, 1), Dropout(0.5), Dropout(0.5))
    seed_dropout(network, 1)
    x = torch.ones(1000)
    assert not torch.equal(network[1](x), network[2](x))


def test_the_stream_is_no_part_of_the_weights() -> None:
    assert list(Dropout(0.5).state_dict()) == []
