"""The learner: two networks, an optimizer, and the update that moves them."""

import copy
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.func import functional_call

from atlantis_exp.learning.objectives import Objective, action_values, td_errors

_MEASURES = ("loss", "q", "target", "gradient_norm")


class Learner:
    """Learns action values by gradient steps on `network`, which `target` follows by a share `tau` (report figure 2.5).

    `target` moves after every `target_every` updates: with tau below 1 it follows softly, with tau 1 it is a copy.
    Both networks lie on one device, which is where the learner works; `target` is by custom a copy of `network`.
    Weights are float32. With precision "bf16" the forward and backward passes run in bfloat16 (autocast), the loss, the
    optimizer and the soft update in float32.

    The network is in eval mode but for its pass over s_t: acting draws no dropout mask and moves no running statistics.
    The target network is in eval mode too, and its running statistics follow the network's as its parameters do. The
    report leaves it in train mode (dropout and batch statistics in its targets) and moves its parameters alone:
    target_mode "train".

    Statistics gather on the device: `update` never waits for it.
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
    ) -> None:
        self.network = network.eval()
        self.target = target.train(target_mode == "train")
        self.optimizer = optimizer
        self.objective = objective
        self.tau = tau  # share of the network that enters the target network
        self.target_every = target_every  # updates
        self.dtype = torch.bfloat16 if precision == "bf16" else torch.float32
        self._q_online = _QFunction(network, self.dtype)
        self._q_target = _QFunction(target, self.dtype)
        self.target_mode = target_mode
        self.updates = 0
        self.device = next(network.parameters()).device
        self._sums = torch.zeros(len(_MEASURES), device=self.device)
        self._measured = 0  # updates in the sums
        self._first_nonfinite = torch.full((), -1, device=self.device)

    def update(
        self,
        s_t: npt.NDArray[np.uint8],
        a_t: npt.NDArray[np.integer],
        r_t: npt.NDArray[np.floating],
        s_tpm: npt.NDArray[np.uint8],
        discount: npt.NDArray[np.floating],
        weights: npt.NDArray[np.floating] | None = None,
    ) -> torch.Tensor:
        """Take one optimizer step on a batch of transitions, then move the target network if its turn has come.

        States (B, C, H, W) in 0..255; actions, rewards and discounts (B,), as `Objective` wants them; weights (B,) of
        the samples in the loss. Returns what each sample's value was off its target by, (B,), on the device.
        """
        actions = torch.as_tensor(a_t, dtype=torch.int64, device=self.device)
        rewards = torch.as_tensor(r_t, dtype=torch.float32, device=self.device)
        discounts = torch.as_tensor(discount, dtype=torch.float32, device=self.device)

        with torch.no_grad():
            target = self.objective.targets(rewards, self._input(s_tpm), discounts, self._q_online, self._q_target)
        self.network.train()
        q = self._q_online(self._input(s_t))
        self.network.eval()
        losses = self.objective.losses(q, actions, target)
        if weights is not None:
            losses = losses * torch.as_tensor(weights, dtype=torch.float32, device=self.device)
        loss = losses.mean()
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._measure(loss.detach(), q.detach(), target)
        self.optimizer.step()
        self._q_online.refresh()
        self.updates += 1
        if self.updates % self.target_every == 0:
            self._move_target()
        return td_errors(q.detach(), actions, target)

    @torch.inference_mode()
    def q_values(self, states: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Return the network's values (B, A) of states (B, C, H, W) in 0..255; changes nothing."""
        values: npt.NDArray[np.float32] = action_values(self._q_online(self._input(states))).cpu().numpy()
        return values

    @property
    def learning_rate(self) -> float:
        """The step size of all parameter groups."""
        rate: float = self.optimizer.param_groups[0]["lr"]
        return rate

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = value

    def statistics(self) -> dict[str, float]:
        """Return the means over the updates since the last call and start anew; waits for the device.

        Loss and the norm of its gradient; q, the values of all actions at s_t; target, what they are drawn to. Empty
        if there was no update.
        """
        if self._measured == 0:
            return {}
        means = (self._sums / self._measured).tolist()
        self._sums.zero_()
        self._measured = 0
        return dict(zip(_MEASURES, means, strict=True))

    def first_nonfinite_update(self) -> int | None:
        """Return the index of the first update whose loss was infinite or no number, None if all were finite; waits
        for the device."""
        index = int(self._first_nonfinite)
        return None if index < 0 else index

    def state_dict(self) -> dict[str, Any]:
        """Return all that a continuation needs; the optimizer's settings but its learning rate are the caller's.

        Tensors are the live ones: write or copy them before the next update.
        """
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
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where the learner stood that `state_dict` described."""
        self.network.load_state_dict(state["network"])
        self.target.load_state_dict(state["target"])
        self.optimizer.load_state_dict(
            {
                # copies, since the optimizer keeps what it is given
                "state": {int(index): copy.deepcopy(values) for index, values in state["optimizer"].items()},
                "param_groups": self.optimizer.state_dict()["param_groups"],
            }
        )
        self.learning_rate = state["learning_rate"]
        for name, generator in self._generators().items():
            generator.set_state(state["generators"][name].cpu())
        self.updates = state["updates"]
        self._sums.copy_(state["sums"])
        self._measured = state["measured"]
        self._first_nonfinite.copy_(state["first_nonfinite"])
        self._q_online.refresh()
        self._q_target.refresh()

    def _input(self, states: npt.NDArray[np.uint8]) -> torch.Tensor:
        """Return states in [0, 1] in the precision of the forward pass."""
        return torch.from_numpy(states).to(self.device).to(self.dtype).div_(255)

    def _measure(self, loss: torch.Tensor, q: torch.Tensor, target: torch.Tensor) -> None:
        gradient_norm = nn.utils.get_total_norm([p.grad for p in self.network.parameters() if p.grad is not None])
        self._sums += torch.stack((loss, q.mean(), target.mean(), gradient_norm))
        self._measured += 1
        first = ~loss.isfinite() & (self._first_nonfinite < 0)
        self._first_nonfinite.masked_fill_(first, self.updates)

    @torch.no_grad()
    def _move_target(self) -> None:
        torch._foreach_lerp_(list(self.target.parameters()), list(self.network.parameters()), self.tau)
        if self.target_mode == "eval":
            for running, latest in zip(self.target.buffers(), self.network.buffers(), strict=True):
                if running.is_floating_point():
                    running.lerp_(latest, self.tau)
                else:
                    running.copy_(latest)
        self._q_target.refresh()

    def _generators(self) -> dict[str, torch.Generator]:
        """Return the random streams of both networks: whatever their modules hold as `generator`."""
        return {
            f"{role}.{name}": module.generator
            for role, network in (("network", self.network), ("target", self.target))
            for name, module in network.named_modules()
            if isinstance(getattr(module, "generator", None), torch.Generator)
        }


class _QFunction:
    """A network as a function to float32 values, its passes in float32 or in bfloat16 (autocast).

    For bfloat16 it keeps casts of the network's matrices: autocast would make the same ones at every call, and for one
    state that takes longer than the arithmetic. `refresh` them when the parameters have moved.
    """

    def __init__(self, network: nn.Module, dtype: torch.dtype) -> None:
        self.network = network
        self.dtype = dtype
        self.matrices = {
            name: (parameter, parameter.detach().to(dtype))
            for name, parameter in network.named_parameters()
            if dtype is torch.bfloat16 and parameter.ndim > 1
        }

    def __call__(self, states: torch.Tensor) -> torch.Tensor:
        casts = {
            name: _Cast.apply(master, cast)  # type: ignore[no-untyped-call]
            for name, (master, cast) in self.matrices.items()
        }
        with torch.autocast(states.device.type, torch.bfloat16, enabled=self.dtype is torch.bfloat16):
            q: torch.Tensor = functional_call(self.network, casts, (states,))
        return q.float()

    @torch.no_grad()
    def refresh(self) -> None:
        for master, cast in self.matrices.values():
            cast.copy_(master)


class _Cast(torch.autograd.Function):
    """The cast of a matrix that was made before; its gradient goes to the matrix."""

    @staticmethod
    def forward(ctx: Any, master: torch.Tensor, cast: torch.Tensor) -> torch.Tensor:  # noqa: ARG004
        return cast.view_as(cast)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:  # noqa: ARG004
        return gradient.float(), None
