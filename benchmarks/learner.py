"""Compare the learner's FLOP rate with the machine's: `python -m benchmarks.learner`.

Torch's counter gives an update's FLOPs: convolutions and matrix products of the online network's forward and backward
pass and of the target network's forward pass, without the gradient of the states. The time is that of
`Learner.update`, from uint8 to loss, optimizer and soft update. Each turn is compared with a multiplication of square
matrices in the same format, right before it in the same process.

`--against OVERRIDE...` also measures the same updates with these overrides: `compile=true`, `training.ema=2000`.
"""

import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from atlantis_exp import terminal
from atlantis_exp.build import build_learner, choose_device, choose_precision
from atlantis_exp.config import Config
from atlantis_exp.sessions.processor import set_up_torch
from benchmarks.composition import composed
from benchmarks.contest import calls_per_second, parser_of, print_results, print_table, run, take_turns

_SIDE = 2_048  # of the square matrices; larger ones were no faster


class Case(NamedTuple):
    """A network with its batch and number format."""

    model: str
    batch_size: int  # transitions
    precision: str

    @property
    def name(self) -> str:
        return f"{self.model}_{self.precision}"

    def config(self, *overrides: str) -> Config:
        named = (f"model={self.model}", f"training.batch_size={self.batch_size}")
        return composed(*named, f"training.precision={self.precision}", *overrides)


CASES = tuple(Case(*network, precision) for network in (("cnn", 128), ("resnet", 32)) for precision in ("bf16", "fp32"))


def update_of(config: Config) -> Callable[[], object]:
    """Return an update of a learner on a batch of noise; set torch's threads as in a training."""
    set_up_torch(config, config.device)
    learner, batch_size = build_learner(config), config.training.batch_size
    rng = np.random.default_rng(0)
    # In the replay memory's layout: frame by frame, viewed as state by state.
    frames = rng.integers(0, 256, (len(config.env.lags) + 1, batch_size, config.env.size, config.env.size), np.uint8)
    states = frames.swapaxes(0, 1)
    batch = (
        states[:, :-1],
        rng.integers(4, size=batch_size),
        np.zeros(batch_size, np.float32),
        states[:, 1:],
        np.full(batch_size, config.objective.gamma, np.float32),
    )
    return lambda: learner.update(*batch).cpu()  # waits for a GPU


def flops_of(config: Config) -> int:
    """Return the floating-point operations of a learner's update."""
    env = config.env
    return build_learner(config).update_flops(env.state_shape, config.training.batch_size)


def gemm_of(precision: str) -> Callable[[], None]:
    """Return a multiplication of two square matrices."""
    device = choose_device("auto")
    dtype = torch.bfloat16 if precision == "bf16" else torch.float32
    a, b = torch.ones(2, _SIDE, _SIDE, device=device, dtype=dtype)
    product = torch.empty_like(a)

    def multiply() -> None:
        torch.mm(a, b, out=product)
        if device.type == "cuda":
            torch.cuda.synchronize()

    return multiply


def chosen(names: Sequence[str] | None) -> list[Case]:
    """Return the named cases; by default all but those whose format is slower than float32 here."""
    if names is not None:
        return [case for case in CASES if case.name in names]
    if choose_precision("auto", choose_device("auto")) == "bf16":
        return [*CASES]
    print("bfloat16 is slower than float32 here: its cases are left out; --cases cnn_bf16 measures one", flush=True)
    return [case for case in CASES if case.precision != "bf16"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and the JSON line."""
    parser = parser_of("learner", __doc__, rounds=7, seconds=2.0)
    parser.add_argument("--cases", nargs="+", choices=[case.name for case in CASES], default=None)
    parser.add_argument("--against", nargs="+", metavar="OVERRIDE", default=(), help="updates to compare with these")
    args = parser.parse_args(arguments)
    cases = chosen(args.cases)
    others = {case: case.config(*args.against) for case in cases if args.against}

    threads = torch.get_num_threads()
    turns: dict[str, Callable[[], float]] = {}
    flops: dict[str, int] = {}

    def measured(call: Callable[[], object], threads: int) -> Callable[[], float]:
        def turn() -> float:
            torch.set_num_threads(threads)
            return calls_per_second(call, args.seconds)

        torch.set_num_threads(threads)
        call()  # a first call allocates, or compiles
        return turn

    with terminal.working("first updates", lambda: f"{len(turns)} done"):
        for case in cases:
            config = case.config()
            flops[f"gemm_{case.name}"], flops[case.name] = 2 * _SIDE**3, flops_of(config)
            turns[f"gemm_{case.name}"] = measured(gemm_of(case.precision), threads)
            update = update_of(config)
            turns[case.name] = measured(update, torch.get_num_threads())
            if case in others:
                update = update_of(others[case])
                turns[f"{case.name}_against"] = measured(update, torch.get_num_threads())
    calls = take_turns(turns, args.rounds)

    results: dict[str, Any] = {"threads": threads}
    rows, compared = [], []
    for case in cases:
        rate, gemm_rate = (statistics.median(calls[name]) * flops[name] for name in (case.name, f"gemm_{case.name}"))
        shares = [
            update * flops[case.name] / (gemm * flops[f"gemm_{case.name}"])
            for update, gemm in zip(calls[case.name], calls[f"gemm_{case.name}"], strict=True)
        ]
        share = statistics.median(shares)
        seconds = 1 / statistics.median(calls[case.name])
        suffix = "" if case.precision == "bf16" else "_fp32"
        results[f"gemm_share_{case.model}{suffix}"] = share
        results[f"update_seconds_{case.name}"] = seconds
        results[f"flops_a_sample_{case.model}"] = flops[case.name] / case.batch_size
        rows.append(
            (
                case.name,
                f"{case.batch_size}",
                f"{flops[case.name] / case.batch_size / 1e6:,.0f} M",
                f"{seconds * 1e3:.1f} ms",
                f"{rate / 1e9:,.0f} G/s",
                f"{gemm_rate / 1e9:,.0f} G/s",
                f"{share:.0%} ({min(shares):.0%}-{max(shares):.0%})",
            )
        )
        if case in others:
            pairs = zip(calls[f"{case.name}_against"], calls[case.name], strict=True)
            ratios = [against / plain for against, plain in pairs]
            results[f"against_{case.name}"] = ratio = statistics.median(ratios)
            compared.append((case.name, f"{ratio:.3f} ({min(ratios):.3f}-{max(ratios):.3f})"))
    columns = ("", "batch", "FLOPs a sample", "update", "FLOPs", "GEMM", "share")
    print_table(f"one update, {threads} threads", columns, rows)
    if compared:
        print_table(" ".join(args.against), ("", "times as many updates a second"), compared)
    print_results(results)


if __name__ == "__main__":
    run(main)
