"""Update networks with a memory, from sequences."""

from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from atlantis_exp.learning.learner import Learner, Passed
from atlantis_exp.learning.objectives import QFunction, td_errors
from atlantis_exp.learning.values import Recurrent

_MOST = 0.9  # of a sequence's largest error in its priority; the rest is the mean's (Kapturowski et al. 2019)


class RecurrentLearner(Learner):
    """Learn as `Learner`, from sequences of transitions (R2D2, Kapturowski et al. 2019).

    The network's memory is recomputed with the latest weights, from zero over a burn-in without gradients; R2D2 also
    tries stored memories, which the replay memory does not hold. A sequence's loss is the sum over its transitions,
    divided by `unroll`; a transition counts once, however many places it fills, except in the statistics of values.

    ahead: steps of a sequence after the last one to learn. Other arguments as for `Learner`.
    """

    def __init__(self, network: nn.Module, *arguments: Any, ahead: int, **options: Any) -> None:
        super().__init__(network, *arguments, **options)
        self.core = cast(Recurrent, network)
        self._ahead = ahead

    def evaluated_step(
        self, states: npt.NDArray[np.uint8], memory: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return the values (B, A) of the network to evaluate, and its memory (B, units) after the states."""
        return self.step(states, memory, self._evaluated)

    def _passes(self, online: nn.Module, target_network: nn.Module, *batch: npt.NDArray[Any]) -> Passed:
        """Pass a shard of `Sequences` through both networks."""
        states, first, last, a_t, r_t, m, discount = batch
        size, unroll, burn_in = len(states), self.core.unroll, self.core.burn_in
        x = self._input(states.reshape(-1, *states.shape[2:])).reshape(states.shape)
        before, after = x[:, :burn_in], x[:, burn_in:]
        nothing = torch.zeros(size, self.core.units, device=self.device)
        first_B, last_B = self._sent(first) - burn_in, self._sent(last) - burn_in  # steps after the burn-in
        rows_B1 = torch.arange(size, device=self.device).unsqueeze(1)
        step_1L = torch.arange(unroll, device=self.device).unsqueeze(0)
        step_BL = step_1L.clamp(first_B.unsqueeze(1), last_B.unsqueeze(1))
        is_learned = step_BL == step_1L
        actions = self._sent(a_t).flatten()

        def values_of(network: nn.Module, h: torch.Tensor) -> QFunction:
            def values(at: torch.Tensor) -> torch.Tensor:
                q_BT, _ = cast(Recurrent, network).sequence(after, h, first_B)
                return q_BT.float()[rows_B1, at.view(size, unroll)].flatten(0, 1)

            return values

        with torch.no_grad():
            h, h_target = (
                cast(Recurrent, network).sequence(before, nothing, first_B + burn_in)[1]
                for network in (online, target_network)
            )
            target = self.objective.targets(
                self._floats(r_t).flatten(),
                (step_BL + self._sent(m)).flatten(),
                self._floats(discount).flatten(),
                values_of(online, h),
                values_of(target_network, h_target),
            )
        online.train()
        q_BL, _ = cast(Recurrent, online).sequence(after[:, :unroll], h, first_B)
        online.eval()
        q = q_BL.float()[rows_B1, step_BL].flatten(0, 1)
        losses = (self.objective.losses(q, actions, target).view(size, unroll) * is_learned).sum(1) / unroll
        q = q.detach()
        errors = td_errors(q, actions, target).view(size, unroll) * is_learned
        priorities = _MOST * errors.amax(1) + (1 - _MOST) * errors.sum(1) / is_learned.sum(1)
        return Passed(losses, priorities, q, target)

    def _two_samples(self, state: tuple[int, int, int]) -> tuple[npt.NDArray[Any], ...]:
        unroll, length = self.core.unroll, self.core.burn_in + self.core.unroll + self._ahead
        zeros = np.zeros((2, unroll), np.float32)
        first, last = np.zeros(2, np.int64), np.full(2, self.core.burn_in + unroll - 1)
        whole = np.zeros((2, unroll), np.int64)
        return np.zeros((2, length, *state), np.uint8), first, last, whole, zeros, whole, zeros
