import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch import nn

from atlantis_exp.networks.sizes import convolved, count_parameters


@given(side=st.integers(1, 24), kernel=st.integers(1, 8), stride=st.integers(1, 4))
def test_the_side_after_a_convolution_is_the_one_torch_makes(side: int, kernel: int, stride: int) -> None:
    assume(kernel <= side)
    made = nn.Conv2d(1, 1, kernel, stride)(torch.zeros(1, 1, side, side))
    assert convolved(side, kernel, stride) == made.shape[2]


def test_running_statistics_are_no_parameters() -> None:
    assert count_parameters(nn.Sequential(nn.Linear(3, 5), nn.BatchNorm1d(5))) == (3 * 5 + 5) + (5 + 5)
