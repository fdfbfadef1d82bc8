"""What is built from a config, counted."""

from collections.abc import Callable

from atlantis_exp.build import build_learner
from atlantis_exp.config import Config


def test_the_operations_of_an_update_are_those_counted_by_hand(tiny: Callable[..., Config]) -> None:
    def convolution(channels: int, kernel: int, out: int, side: int) -> int:
        return 2 * channels * kernel**2 * out * side**2

    def counted(*overrides: str) -> int:
        config = tiny(*overrides)
        return build_learner(config).update_flops((4, config.env.size, config.env.size), config.training.batch_size)

    first = convolution(4, 8, 32, 20)
    others = convolution(32, 4, 64, 9) + convolution(64, 3, 64, 7) + 2 * 3_136 * 512 + 2 * 512 * 4
    forward = first + others
    backward = first + 2 * others  # no gradient of the observations
    sample = forward + backward
    assert counted("env.size=84") == 4 * (sample + forward)
    assert counted("env.size=84", "objective=double_dqn") == 4 * (sample + 2 * forward)
    assert 4 * 1.8e9 < counted("model=resnet", "env.size=159") < 4 * 1.9e9
