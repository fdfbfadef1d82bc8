"""What an update minimises: targets to reach at s_t, and the loss of missing them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import torch
from torch.nn.functional import smooth_l1_loss

QFunction: TypeAlias = Callable[[torch.Tensor], torch.Tensor]
"""States (B, C, H, W) in [0, 1] to float32 values (B, A), without gradient and in the mode the learner chose."""


class Objective(Protocol):
    """Targets computed without gradient, then a loss per sample that the learner averages over the batch."""

    def targets(
        self, r_t: torch.Tensor, s_tp1: torch.Tensor, terminated: torch.Tensor, online: QFunction, target: QFunction
    ) -> torch.Tensor:
        """Return the target of each sample, (B,).

        `terminated` (B,) bool cuts the bootstrap; a truncated episode's last transition is not terminated.
        """
        ...

    def losses(self, q_BA: torch.Tensor, a_t: torch.Tensor, target_B: torch.Tensor) -> torch.Tensor:
        """Return the loss of each sample, (B,)."""
        ...


@dataclass(frozen=True)
class DQN:
    """The target network chooses the next action and values it (Mnih et al. 2015; report figure 2.5)."""

    gamma: float  # discount a step

    def targets(
        self,
        r_t: torch.Tensor,
        s_tp1: torch.Tensor,
        terminated: torch.Tensor,
        online: QFunction,  # noqa: ARG002 - only Double DQN asks it
        target: QFunction,
    ) -> torch.Tensor:
        v_tp1 = target(s_tp1).amax(1)
        return torch.where(terminated, r_t, r_t + self.gamma * v_tp1)

    def losses(self, q_BA: torch.Tensor, a_t: torch.Tensor, target_B: torch.Tensor) -> torch.Tensor:
        return huber(q_BA, a_t, target_B)


@dataclass(frozen=True)
class DoubleDQN:
    """The online network chooses the next action, the target network values it (van Hasselt et al. 2016, equation 4).

    The online network chooses in eval mode, as it does when it acts: without dropout and with running statistics,
    which s_tp1 therefore leaves alone.
    """

    gamma: float  # discount a step

    def targets(
        self, r_t: torch.Tensor, s_tp1: torch.Tensor, terminated: torch.Tensor, online: QFunction, target: QFunction
    ) -> torch.Tensor:
        a_tp1 = online(s_tp1).argmax(1, keepdim=True)
        v_tp1 = target(s_tp1).gather(1, a_tp1).squeeze(1)
        return torch.where(terminated, r_t, r_t + self.gamma * v_tp1)

    def losses(self, q_BA: torch.Tensor, a_t: torch.Tensor, target_B: torch.Tensor) -> torch.Tensor:
        return huber(q_BA, a_t, target_B)


def huber(q_BA: torch.Tensor, a_t: torch.Tensor, target_B: torch.Tensor) -> torch.Tensor:
    """Return the smooth L1 loss of the taken actions' values, (B,): half the squared error up to 1, linear beyond."""
    q_B = q_BA.gather(1, a_t.unsqueeze(1)).squeeze(1)
    return smooth_l1_loss(q_B, target_B, reduction="none")
