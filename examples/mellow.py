"""An objective: value the next state by a soft maximum of its actions' values (mellowmax)."""

import math
from dataclasses import dataclass

import torch

from atlantis_exp.components import Positive, component
from atlantis_exp.learning.objectives import DQN, QFunction, bootstrapped


@component("mellow", "objective")
@dataclass(frozen=True)
class MellowObjective(DQN):
    """DQN with mellowmax in place of the maximum (Asadi and Littman 2017)."""

    omega: Positive = 5.0

    def targets(
        self, r_t: torch.Tensor, s_tpm: torch.Tensor, discount: torch.Tensor, online: QFunction, target: QFunction
    ) -> torch.Tensor:
        q_BA = target(s_tpm)
        v_B = (torch.logsumexp(self.omega * q_BA, 1) - math.log(q_BA.shape[1])) / self.omega
        return bootstrapped(r_t, discount, v_B)
