"""Say a family's answer in a sentence or two, and where its looks stand."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from atlantis_exp.comparison.decision import Plan, Verdict
from atlantis_exp.comparison.verdict import Answer, Question

IN_FULL = 3  # pairs of a family, up to which each is said with its interval
_LISTED = 6  # undecided pairs, up to which they are named
_NAMED = 3  # of many runs


def measure(question: Question) -> str:
    """Say what a seed's score is."""
    match question.score:
        case "last":
            return "the interquartile mean (IQM) of the seed's evaluated episodes after its last step"
        case "training":
            return (
                f"the seed's points in the last {100 * question.window:g}% of its training over the episodes that "
                "ended there: with the training's epsilon and latest weights, so it measures the process of learning, "
                "not the network one keeps"
            )
        case _:
            return "the mean of the seed's rows in a table"


def said(answer: Answer) -> str:
    """Say what is decided and what is not; the better ones come first."""
    verdicts = answer.decision.verdicts
    in_full = len(verdicts) <= IN_FULL
    baseline = answer.family.plan.baseline
    better: dict[tuple[str, str], list[str]] = defaultdict(list)
    for verdict in verdicts:
        if verdict.said == "worse" and baseline is None:
            better[verdict.other, "better"].append(_gap(verdict, verdict.group, in_full, turned=True))
        elif verdict.said in ("better", "worse"):
            better[verdict.group, verdict.said].append(
                _gap(verdict, verdict.other, in_full, turned=verdict.said == "worse")
            )
    sentences = [f"{name} plays {how} than {' and than '.join(others)}" for (name, how), others in better.items()]
    for verdict in verdicts:
        if verdict.said == "equivalent":
            interval = f" ({_interval(verdict)})" if in_full else ""
            sentences.append(
                f"{verdict.group} is as good as {verdict.other}: no difference larger than "
                f"{margin(answer.family.plan)}{interval}"
            )
    if unsure := [verdict for verdict in verdicts if verdict.said == "not decided"]:
        sentences.append(_undecided(answer, unsure))
    return ". ".join(sentences) + "."


def _undecided(answer: Answer, verdicts: Sequence[Verdict]) -> str:
    decision, in_full = answer.decision, len(answer.decision.verdicts) <= IN_FULL
    if len(verdicts) > _LISTED:
        text = f"Not decided: {len(verdicts)} of {len(decision.verdicts)} pairs"
    else:
        text = "Not decided: " + ", ".join(
            f"{verdict.group} against {verdict.other}"
            + (
                f" (difference {_points(verdict.difference)}, {_interval(verdict)})"
                if in_full and verdict.seeds
                else ""
            )
            for verdict in verdicts
        )
    if decision.next_look is not None:
        there = {value: len(answer.family.seeds[value]) for value in decision.contenders}
        fewer = [f"{value} has {seeds}" for value, seeds in there.items() if seeds < decision.next_look]
        sizes = set(there.values())
        listed = f" ({', '.join(fewer)})" if 0 < len(fewer) <= _LISTED else ""
        listed = f" (there are {min(sizes)} each)" if len(sizes) == 1 else listed
        return f"{text}; next look at {decision.next_look} seeds{listed}"
    reach = max((verdict.detectable or 0.0 for verdict in verdicts), default=0.0)
    if not reach:
        return f"{text}, and there is no further look; no group's seeds differ, so what it would have found is unknown"
    return f"{text}, and there is no further look; a difference of {_points(reach)} would have been found with 80 %"


def spent(answer: Answer) -> str:
    """Say which looks were planned and taken, and the error spent."""
    plan, looks = answer.family.plan, answer.decision.looks
    return (
        f"looks planned at {' and '.join(map(str, plan.looks))} seeds; "
        f"taken: {', '.join(str(look.size) for look in looks) or 'none'}; "
        f"error spent: {answer.decision.spent:.2%} of {plan.error:.2%}"
    )


def margin(plan: Plan) -> str:
    """Return the plan's delta as a person writes it; empty without one."""
    if plan.delta is None:
        return ""
    return f"{100 * plan.delta:g} %" if plan.relative else f"{_points(plan.delta)} points"


def listed(names: Sequence[str]) -> str:
    """Return names in a row, the first three of many."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _gap(verdict: Verdict, other: str, in_full: bool, turned: bool) -> str:
    if not in_full:
        return other
    return f"{other} by {_points(abs(verdict.difference))} points ({_interval(verdict, turned)})"


def _interval(verdict: Verdict, turned: bool = False) -> str:
    low, high = (-verdict.high, -verdict.low) if turned else (verdict.low, verdict.high)
    return f"{_points(low)} to {_points(high)}, {verdict.seeds} seeds each"


def _points(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 10 or value == np.round(value) else f"{value:.3g}"
