"""Compute the targets and the loss of an update."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeAlias

import torch
from torch.nn.functional import smooth_l1_loss

from atlantis_exp.components import Quantiles, Rescaling

QFunction: TypeAlias = Callable[[torch.Tensor], torch.Tensor]
"""Maps states (B, C, H, W) in [0, 1] to float32 values (B, A), or to N quantiles of each (B, A, N), without gradient,
in the learner's choice of mode."""


class Objective(Protocol):
    """Compute targets without gradient, then a loss per sample, which the learner averages over the batch.

    With a network that has a memory, s_tpm is one number a sample, which only `online` and `target` can read.

    A sample's reward and discount (B,) cover the m steps from s_t to s_tpm. Discount 0 cuts the bootstrap, as after a
    terminated episode; the last transition of a truncated episode keeps its discount.
    """

    def targets(
        self, r_t: torch.Tensor, s_tpm: torch.Tensor, discount: torch.Tensor, online: QFunction, target: QFunction
    ) -> torch.Tensor:
        """Return the target of each sample, (B,), or its N quantiles, (B, N)."""
        ...

    def losses(self, q: torch.Tensor, a_t: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the loss of each sample, (B,), from values or quantiles q at s_t and the result of `targets`."""
        ...


def action_values(q: torch.Tensor) -> torch.Tensor:
    """Return values (B, A) unchanged, or the mean of quantiles (B, A, N)."""
    return q if q.ndim == 2 else q.mean(2)


@dataclass(frozen=True)
class DQN:
    """The target network chooses the next action and values it (Mnih et al. 2015; report figure 2.5)."""

    def targets(
        self, r_t: torch.Tensor, s_tpm: torch.Tensor, discount: torch.Tensor, online: QFunction, target: QFunction
    ) -> torch.Tensor:
        return bootstrapped(r_t, discount, self._next_values(s_tpm, online, target))

    def _next_values(self, s_tpm: torch.Tensor, online: QFunction, target: QFunction) -> torch.Tensor:  # noqa: ARG002
        q = target(s_tpm)
        return taken(q, action_values(q).argmax(1))

    def losses(self, q: torch.Tensor, a_t: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return smooth_l1_loss(taken(q, a_t), target, reduction="none")


@dataclass(frozen=True)
class DoubleDQN(DQN):
    """The online network chooses the next action, the target network values it (van Hasselt et al. 2016, equation 4).

    The online network chooses in eval mode, as when it acts: without dropout and with running statistics, which s_tpm
    does not change.
    """

    def _next_values(self, s_tpm: torch.Tensor, online: QFunction, target: QFunction) -> torch.Tensor:
        a_tpm = action_values(online(s_tpm)).argmax(1)
        return taken(target(s_tpm), a_tpm)


@dataclass(frozen=True)
class Quantile(DQN):
    """QR-DQN: N quantiles of the return, whose mean is the value (Dabney et al. 2018, algorithm 1, kappa 1).

    The target network chooses the next action by their mean and gives its quantiles.
    """

    head: ClassVar = "quantile"
    quantiles: Quantiles

    def losses(self, q: torch.Tensor, a_t: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the quantile Huber loss of each sample, (B,): a sum over its quantiles, a mean over the target's."""
        z_BN = taken(q, a_t)
        count = z_BN.shape[1]
        z_BNN, target_BNN = z_BN.unsqueeze(2).expand(-1, -1, count), target.unsqueeze(1).expand(-1, count, -1)
        midpoint_N1 = (torch.arange(count, device=q.device).unsqueeze(1) + 0.5) / count
        weight_BNN = (midpoint_N1 - (target_BNN < z_BNN).float()).abs()
        return (weight_BNN * smooth_l1_loss(z_BNN, target_BNN, reduction="none")).mean(2).sum(1)


@dataclass(frozen=True)
class DoubleQuantile(Quantile, DoubleDQN):
    """QR-DQN whose online network chooses the next action, as in Double DQN; the target network gives its quantiles."""


@dataclass(frozen=True)
class _Rescaled(DQN):
    """Learn h(return), which shrinks large returns; undo h to add rewards (Pohlen et al. 2018, equation 5)."""

    rescaling: Rescaling

    def targets(
        self, r_t: torch.Tensor, s_tpm: torch.Tensor, discount: torch.Tensor, online: QFunction, target: QFunction
    ) -> torch.Tensor:
        rescale, undo = RESCALINGS[self.rescaling]
        return rescale(bootstrapped(r_t, discount, undo(self._next_values(s_tpm, online, target))))


@dataclass(frozen=True)
class RescaledDoubleDQN(_Rescaled, DoubleDQN):
    """Double DQN on rescaled returns, as in R2D2 (Kapturowski et al. 2019)."""


@dataclass(frozen=True)
class RescaledQuantile(_Rescaled, Quantile):
    """QR-DQN on rescaled returns; its quantiles are the rescaled quantiles of the returns.

    The mean of the rescaled quantiles, which chooses actions, is below the rescaled mean if returns vary.
    """


_EPSILON = 1e-3  # keeps h's inverse from growing without bound (Pohlen et al. 2018, proposition A.2)


def signed_sqrt(x: torch.Tensor) -> torch.Tensor:
    """Return sign(x) (sqrt(|x| + 1) - 1) + .001 x (Pohlen et al. 2018)."""
    return x.sign() * ((x.abs() + 1).sqrt() - 1) + _EPSILON * x


def undo_signed_sqrt(x: torch.Tensor) -> torch.Tensor:
    """Return the inverse of `signed_sqrt` (Pohlen et al. 2018, proposition A.2)."""
    inside = x.abs() + 1 + _EPSILON
    # The paper's (root - 1) / (2 epsilon) times (root + 1) / (root + 1): in float32 the difference loses digits.
    return x.sign() * ((2 * inside / ((1 + 4 * _EPSILON * inside).sqrt() + 1)) ** 2 - 1)


def symlog(x: torch.Tensor) -> torch.Tensor:
    """Return sign(x) log(|x| + 1) (Hafner et al. 2023)."""
    return x.sign() * x.abs().log1p()


def undo_symlog(x: torch.Tensor) -> torch.Tensor:
    """Return the inverse of `symlog`."""
    return x.sign() * x.abs().expm1()


RESCALINGS = {"signed_sqrt": (signed_sqrt, undo_signed_sqrt), "symlog": (symlog, undo_symlog)}


def td_errors(q: torch.Tensor, a_t: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the absolute error of each sample's value, or of its quantiles' mean, (B,)."""
    error = target - taken(q, a_t)
    return (error if error.ndim == 1 else error.mean(1)).abs()


def taken(q: torch.Tensor, a_t: torch.Tensor) -> torch.Tensor:
    """Return the entries of q, (B, A) or (B, A, N), for one action of each sample."""
    return q[torch.arange(len(a_t), device=q.device), a_t]


def bootstrapped(r_t: torch.Tensor, discount: torch.Tensor, v_tpm: torch.Tensor) -> torch.Tensor:
    """Return rewards plus discounted values (B,) or quantiles (B, N); discount 0 cancels even infinite values."""
    r_t, discount = (each.view(-1, *(1 for _ in v_tpm.shape[1:])) for each in (r_t, discount))
    return torch.where(discount == 0, r_t, r_t + discount * v_tpm)
