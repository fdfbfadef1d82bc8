"""Update two networks with an optimizer."""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from atlantis_exp.learning.objectives import Objective, td_errors
from atlantis_exp.learning.values import ActionValues, Replicas, generators_of

_MEASURES = ("loss", "q", "target", "gradient_norm")
_AVERAGE_EVERY = 10  # updates, since averaging weights moves as much memory as the optimizer does


class Passed(NamedTuple):
    """The results of a shard's passes, on the device."""

    losses: torch.Tensor  # (B,), with gradients
    errors: torch.Tensor  # (B,), absolute
    q: torch.Tensor
    target: torch.Tensor


class Learner(ActionValues):
    """Learn action values by gradient steps on `network`, which `target` follows by a share `tau` (report figure 2.5).

    `target` moves after every `target_every` updates: with tau below 1 it follows softly, with tau 1 it is a copy.
    Both networks are on one device; weights are float32. With precision "bf16" the forward and backward passes run in
    bfloat16, the loss, the optimizer and the soft update in float32.

    With several shards, one thread computes each part of a batch from the states to the gradients. Threads then wait
    for each other once an update instead of after every operation: as fast on a quiet machine, several times faster on
    a busy one (docs/performance.md). Raises ValueError unless the network's class sets `splits_batches`: no batch norm,
    no shared dropout generator.

    The network is in train mode only for its pass over s_t, the target network never: its running statistics follow the
    network's as its parameters do. The report leaves it in train mode (dropout and batch statistics in its targets) and
    moves only its parameters: target_mode "train".

    `evaluated` is the network to evaluate: the online one or, with `ema`, an exponential moving average of its weights
    over about as many updates, which does not influence learning.

    Statistics accumulate on the device, so `update` never waits for it. Batches reach a GPU from pinned memory.

    compile: compiles both networks for updates, as torch.compile does, but not for acting, whose batches vary in size.
    """

    def __init__(
        self,
        network: nn.Module,
        target: nn.Module,
        optimizer: torch.optim.Optimizer,
        objective: Objective,
        tau: float,
        *,
        target_every: int = 1,
        precision: Literal["fp32", "bf16"] = "fp32",
        target_mode: Literal["eval", "train"] = "eval",
        shards: int = 1,
        ema: int | None = None,
        compile: Callable[[nn.Module], nn.Module] | None = None,
    ) -> None:
        super().__init__(network, precision=precision, shards=shards)
        self.target = target.train(target_mode == "train")
        self.optimizer = optimizer
        self.objective = objective
        self.tau = tau  # share of the network that enters the target network
        self.target_every = target_every  # updates
        self._target = Replicas(target, self.dtype, shards)
        self.ema = ema  # updates
        self.evaluated = copy.deepcopy(network) if ema else network
        self._evaluated = Replicas(self.evaluated, self.dtype, shards) if ema else self._online
        self._online_passes, self._target_passes = (
            [compile(network) for network in replicas.networks] if compile else replicas.networks
            for replicas in (self._online, self._target)
        )
        self.target_mode = target_mode
        self.updates = 0
        self._has_begun_with = False  # given weights, which the average has, too
        self._sums = torch.zeros(len(_MEASURES), device=self.device)
        self._measured = 0  # updates in the sums
        self._first_nonfinite = torch.full((), -1, device=self.device)

    def begin_with(self, weights: Mapping[str, torch.Tensor]) -> None:
        """Load weights into all networks before the first update. Raises: RuntimeError."""
        for network in (self.network, self.target, self.evaluated):
            network.load_state_dict(weights)
        for replicas in (self._online, self._target, self._evaluated):
            replicas.refresh()
        self._has_begun_with = True

    def update(self, *batch: npt.NDArray[Any], weights: npt.NDArray[np.floating] | None = None) -> torch.Tensor:
        """Take one optimizer step on a batch of transitions, then update target and average if due.

        batch: s_t, a_t, r_t, s_tpm and discount: states (B, C, H, W) in 0..255; actions, rewards and discounts (B,), as
        `Objective` needs them. weights: (B,), of the samples in the loss.

        Returns absolute TD errors (B,), on the device.
        """
        size = len(batch[0])
        if weights is None:
            weights = np.ones(size, np.float32)
        parts = self._map_shards(partial(self._gradients, size), self._shards(weights, *batch))
        gradients, means, errors = zip(*parts, strict=True)
        for parameter, gradient in zip(_learned(self.network), _summed(gradients), strict=True):
            parameter.grad = gradient
        self._measure(torch.stack(means).sum(0))
        self.optimizer.step()
        self.updates += 1
        self._online.refresh()
        self._move_target()
        self._move_average()
        return torch.cat(errors)

    def _move_target(self) -> None:
        if self.updates % self.target_every == 0:
            _follow(self.target, self.network, self.tau, buffers=self.target_mode == "eval")
            self._target.refresh()

    def _move_average(self) -> None:
        if self.ema and self.updates % _AVERAGE_EVERY == 0:
            # After random weights take the plain mean until it has `ema` of them.
            first = 0.0 if self._has_begun_with else _AVERAGE_EVERY / self.updates
            share = max(first, _AVERAGE_EVERY / self.ema)
            _follow(self.evaluated, self.network, share, buffers=True)
            self._evaluated.refresh()

    def _gradients(
        self, batch_size: int, shard: int, weights: npt.NDArray[np.floating], *batch: npt.NDArray[Any]
    ) -> tuple[list[torch.Tensor], torch.Tensor, torch.Tensor]:
        """Return a shard's part of the float32 gradients, of the mean loss, value and target, and of the errors."""
        online = self._online_passes[shard]
        passed = self._passes(online, self._target_passes[shard], *batch)
        loss = (passed.losses * self._floats(weights)).sum() / batch_size
        online.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        gradients = [
            torch.zeros_like(parameter, dtype=torch.float32) if parameter.grad is None else parameter.grad.float()
            for parameter in _learned(online)
        ]
        share = len(weights) / batch_size
        means = torch.stack((loss.detach(), share * passed.q.mean(), share * passed.target.mean()))
        return gradients, means, passed.errors

    def _passes(self, online: nn.Module, target_network: nn.Module, *batch: npt.NDArray[Any]) -> Passed:
        """Pass a shard through both networks, with gradients in the losses alone."""
        s_t, a_t, r_t, s_tpm, discount = batch
        actions = self._sent(a_t).to(torch.int64)
        with torch.no_grad():
            target = self.objective.targets(
                self._floats(r_t),
                self._input(s_tpm),
                self._floats(discount),
                lambda s: online(s).float(),
                lambda s: target_network(s).float(),
            )
        online.train()
        q = online(self._input(s_t)).float()
        online.eval()
        losses = self.objective.losses(q, actions, target)
        q = q.detach()
        return Passed(losses, td_errors(q, actions, target), q, target)

    def _floats(self, array: npt.NDArray[Any]) -> torch.Tensor:
        return self._sent(array).to(torch.float32)

    def evaluated_q_values(self, states: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Return the values (B, A) that `evaluated` gives states (B, C, H, W) in 0..255; change nothing."""
        return self.q_values(states, self._evaluated)

    @property
    def learning_rate(self) -> float:
        """The step size of all parameter groups."""
        rate: float = self.optimizer.param_groups[0]["lr"]
        return rate

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = value

    @contextmanager
    def restored(self) -> Iterator[None]:
        """Restore the learner after the block."""
        state = copy.deepcopy(self.state_dict())
        yield
        self.load_state_dict(state)

    def update_flops(self, state: tuple[int, int, int], batch_size: int) -> int:
        """Return the floating-point operations of one update on batches of states (C, H, W); change nothing.

        Counts convolutions and matrix products in all passes, a multiply-add as two.
        """
        passes = self._online_passes, self._target_passes
        # The counter sees neither other threads nor compiled networks.
        self._online_passes, self._target_passes = self._online.networks, self._target.networks
        with self.restored(), FlopCounterMode(display=False) as counter:
            self._gradients(2, 0, np.zeros(2, np.float32), *self._two_samples(state))
        self._online_passes, self._target_passes = passes
        return int(counter.get_total_flops() * batch_size // 2)

    def _two_samples(self, state: tuple[int, int, int]) -> tuple[npt.NDArray[Any], ...]:
        states, zeros = np.zeros((2, *state), np.uint8), np.zeros(2, np.float32)
        return states, np.zeros(2, np.int64), zeros, states, zeros

    def statistics(self) -> dict[str, float]:
        """Return the means over the updates since the last call, empty without updates; wait for the device.

        Loss and the norm of its gradient; q, the values of all actions at s_t; target, their targets.
        """
        if self._measured == 0:
            return {}
        means = (self._sums / self._measured).tolist()
        self._sums.zero_()
        self._measured = 0
        return dict(zip(_MEASURES, means, strict=True))

    def first_nonfinite_update(self) -> int | None:
        """Return the index of the first update whose loss was not finite, or None; wait for the device."""
        index = int(self._first_nonfinite)
        return None if index < 0 else index

    def state_dict(self) -> dict[str, Any]:
        """Return the state without the optimizer's settings; write or copy the live tensors before the next update."""
        return {
            "network": self.network.state_dict(),
            "target": self.target.state_dict(),
            "optimizer": {str(index): state for index, state in self.optimizer.state_dict()["state"].items()},
            "learning_rate": self.learning_rate,
            "generators": {name: generator.get_state() for name, generator in self._generators().items()},
            "updates": self.updates,
            "sums": self._sums,
            "measured": self._measured,
            "first_nonfinite": self._first_nonfinite,
            **({"evaluated": self.evaluated.state_dict()} if self.ema else {}),
            **({"has_begun_with": True} if self._has_begun_with else {}),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state that `state_dict` returned. Raises: ValueError if the next update would fail."""
        kept = {int(index): values for index, values in state["optimizer"].items()}
        self.network.load_state_dict(state["network"])
        self.target.load_state_dict(state["target"])
        self.optimizer.load_state_dict(
            {
                "state": copy.deepcopy(kept),  # the optimizer keeps its argument
                "param_groups": self.optimizer.state_dict()["param_groups"],
            }
        )
        self.learning_rate = state["learning_rate"]
        for name, generator in self._generators().items():
            generator.set_state(state["generators"][name].cpu())
        self._check_optimizer()
        self.updates, self._measured = int(state["updates"]), int(state["measured"])
        if not 0 <= self._measured <= self.updates < 2**53:
            raise ValueError(f"{self._measured} of {self.updates} updates are measured")
        self._has_begun_with = state.get("has_begun_with", False)
        self._sums.copy_(state["sums"])
        self._first_nonfinite.copy_(state["first_nonfinite"])
        if self.ema:
            self.evaluated.load_state_dict(state["evaluated"])
            self._evaluated.refresh()
        self._online.refresh()
        self._target.refresh()

    def _check_optimizer(self) -> None:
        """Compare the shapes of the loaded state with those after a step, as torch does not. Raises: ValueError."""

        def form(optimizer: torch.optim.Optimizer) -> dict[tuple[int, str], object]:
            return {
                (index, name): isinstance(value, torch.Tensor) and (value.shape, value.dtype)
                for index, kept in optimizer.state_dict()["state"].items()
                for name, value in kept.items()
            }

        trial = copy.deepcopy(self.optimizer)
        trial.state.clear()
        for group in trial.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.zeros_like(parameter) if parameter.requires_grad else None
        trial.step()
        steps = [kept["step"].item() for kept in self.optimizer.state.values() if "step" in kept]
        if self.optimizer.state and (form(self.optimizer) != form(trial) or not all(step >= 0 for step in steps)):
            raise ValueError("the optimizer's state does not fit its parameters")

    def _measure(self, means: torch.Tensor) -> None:
        gradient_norm = nn.utils.get_total_norm([p.grad for p in self.network.parameters() if p.grad is not None])
        self._sums += torch.cat((means, gradient_norm.unsqueeze(0)))
        self._measured += 1
        first = ~means[0].isfinite() & (self._first_nonfinite < 0)
        self._first_nonfinite.masked_fill_(first, self.updates)

    def _generators(self) -> dict[str, torch.Generator]:
        """Return the random streams of both networks."""
        both = {"network": self.network, "target": self.target}
        return {f"{role}.{name}": each for role, network in both.items() for name, each in generators_of(network)}


def _summed(gradients: Sequence[list[torch.Tensor]]) -> list[torch.Tensor]:
    """Add the shards' gradients, parameter by parameter, into the first shard's."""
    total, *others = gradients
    for other in others:
        torch._foreach_add_(total, other)
    return total


def _learned(network: nn.Module) -> list[nn.Parameter]:
    """Return the parameters that learn."""
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


@torch.no_grad()
def _follow(follower: nn.Module, leader: nn.Module, share: float, *, buffers: bool) -> None:
    """Move a network's parameters, and optionally buffers, towards another's by a share of the way."""
    torch._foreach_lerp_(list(follower.parameters()), list(leader.parameters()), share)
    if buffers:
        for running, latest in zip(follower.buffers(), leader.buffers(), strict=True):
            if running.is_floating_point():
                running.lerp_(latest, share)
            else:
                running.copy_(latest)
